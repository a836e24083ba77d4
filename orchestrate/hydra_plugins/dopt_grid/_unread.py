"""Settings that nobody reads: a misspelt ``+key`` must not pass for one that had an effect."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from dopt.errors import unknown_name
from orchestrate.hydra_plugins.dopt_grid._overlay import interpolations

KNOWN = (
    "env",
    "policy",
    "model",
    "learner",
    "task",
    "seed",
    "width",
    "launch",
    "store",
    "executor",
)
"""The top-level keys that a launch reads; Hydra's own come beside them."""


def check_keys(config: DictConfig) -> None:
    """Refuse a top-level key that neither the launch nor another setting refers to.

    Raises
    ------
    SpecificationError
        With the nearest key that is read.
    """
    for key in set(map(str, config)) - {*KNOWN, "hydra"}:
        own = [name for name in map(str, config) if name != "hydra"]
        reference = re.compile(rf"\$\{{[^{{}}]*\b{re.escape(key)}\b")
        if not any(reference.search(text) for _, text in interpolations(config, own)):
            raise unknown_name("setting", key, KNOWN)


def check_launch(launch: Mapping[str, object], folder: Path) -> None:
    """Refuse a setting of the launch, its store or its executor that no configuration file has.

    Parameters
    ----------
    launch
        The sections ``launch``, ``store`` and ``executor`` in plain types.
    folder
        The configuration files.
    """
    executor = launch["executor"]
    name = executor.get("name") if isinstance(executor, Mapping) else None
    _check("launch", launch["launch"], _read(folder / "config.yaml").get("launch"))
    _check("store", launch["store"], {"url": None})
    _check("executor", executor, _read(folder / "executor" / f"{name}.yaml"))


def _check(path: str, given: object, known: object) -> None:
    if not isinstance(given, Mapping) or not isinstance(known, Mapping) or not known:
        return
    for key, value in given.items():
        if key not in known:
            raise unknown_name(f"setting of {path}", key, map(str, known))
        _check(f"{path}.{key}", value, known[key])


def _read(path: Path) -> dict[str, object]:
    """Return the content of a file; nothing for an option of a user's own."""
    content = OmegaConf.to_container(OmegaConf.load(path)) if path.is_file() else {}
    return {str(key): value for key, value in content.items()} if isinstance(content, dict) else {}
