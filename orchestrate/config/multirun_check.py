"""Check that an experiment with sweeps is launched with ``-m``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from orchestrate.cli_parser import UsageError


def require_multirun(overrides: Sequence[str], hydra: DictConfig, folder: Path) -> None:
    """Refuse an experiment whose sweeps would be ignored without ``-m``.

    Parameters
    ----------
    overrides
        Overrides; a sweep whose key is among them is replaced.
    hydra
        Hydra's own settings.
    folder
        Folder of the configuration files, with the default sweeps.

    Raises
    ------
    UsageError
        If a sweep remains.
    """
    named = {word.lstrip("+").partition("=")[0] for word in overrides}
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
