"""One trial is asked for: an experiment that is a grid needs ``-m``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from orchestrate.usage import UsageError


def check_alone(words: Sequence[str], hydra: DictConfig, folder: Path) -> None:
    """Refuse an experiment whose sweeps nobody would see without ``-m``.

    Parameters
    ----------
    words
        The overrides; a sweep whose key is among them is decided.
    hydra
        Hydra's own settings of this command.
    folder
        The configuration files, which say what is swept without any experiment.

    Raises
    ------
    UsageError
        If a sweep is left.
    """
    named = {word.lstrip("+").partition("=")[0] for word in words}
    usual = OmegaConf.select(OmegaConf.load(folder / "config.yaml"), "hydra.sweeper.params")
    sweeps = dict(OmegaConf.select(hydra, "sweeper.params") or {})
    for grid in OmegaConf.select(hydra, "sweeper.grids") or []:
        sweeps |= grid
    left = [
        f"{key}={value}"
        for key, value in sweeps.items()
        if key not in named and (usual or {}).get(key) != value
    ]
    if left:
        raise UsageError(
            f"experiment={hydra.runtime.choices.get('experiment')} is a grid ({' '.join(left)}): "
            f"add -m, or give each of these keys one value for a single trial."
        )
