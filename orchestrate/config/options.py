"""Options of the groups of a launch: files in ``conf/``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore

CONFIGURATION = Path(__file__).resolve().parents[1] / "conf"


@dataclass
class Sweeps:
    """Setting ``hydra.sweeper`` of a grid, which :mod:`orchestrate.config` expands itself.

    ``params`` are sweeps that apply unless the command line sets the same key. ``grids`` defines
    several grids: each entry is merged over ``params``, and trials in several grids run once.
    """

    params: dict[str, Any] = field(default_factory=dict)
    grids: list[dict[str, Any]] = field(default_factory=list)


def register() -> None:
    """Tell Hydra the options that are no files."""
    ConfigStore.instance().store(group="hydra/sweeper", name="grid", node=Sweeps)


def option_names(group: str) -> list[str]:
    """Return the options of a group, those in its folders last; empty for a name of no group."""
    folder = CONFIGURATION / group
    paths = (path.relative_to(folder) for path in folder.rglob("*.yaml")) if group else ()
    names = (path.with_suffix("").as_posix() for path in paths)
    return sorted(names, key=lambda name: ("/" in name, name))
