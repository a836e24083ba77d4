"""Options of the groups of a launch: files in ``conf/``, and classes that need no file.

A file holds the paper's systems and policies with the reasons for their numbers, and whatever
chooses more than one part. Every other system and policy is an option with the defaults of its
class, whose docstring gives units and reasons: ``env=beyond/chain``, ``policy=baseline/prbs``.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping
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
    store = ConfigStore.instance()
    # Hydra copies the store, which nothing changes, with every source of every composition.
    setattr(store, "__deepcopy__", lambda _: store)  # noqa: B010  # mypy forbids the other way
    store.store(group="hydra/sweeper", name="grid", node=Sweeps)
    for path, section in _classes().items():
        group, _, name = path.rpartition("/")
        store.store(group=group, name=name, node=dict(section), package=group.split("/")[0])


def option_names(group: str) -> list[str]:
    """Return the options of a group, those in its folders last; empty for a name of no group."""
    if not group:
        return []
    folder = CONFIGURATION / group
    files = (path.relative_to(folder).with_suffix("") for path in folder.rglob("*.yaml"))
    names = {path.as_posix() for path in files}
    names |= {path.removeprefix(f"{group}/") for path in _classes() if path.startswith(f"{group}/")}
    return sorted(names, key=lambda name: ("/" in name, name))


@functools.cache
def _classes() -> Mapping[str, Mapping[str, object]]:
    """Return the options that are classes without a file: path, and default section."""
    options = {path: _section(name, cls) for path, name, cls in _named()}
    return {
        path: section
        for path, section in options.items()
        if not (CONFIGURATION / f"{path}.yaml").exists()
    }


def _named() -> Iterator[tuple[str, str, type]]:
    """Yield path, name and class of the systems, policies and tasks outside the paper."""
    from dopt.control import TASKS
    from dopt.policies import POLICIES
    from dopt.policies.base import OpenLoop
    from dopt.systems import NAMED_SYSTEMS

    for name, system in NAMED_SYSTEMS.items():
        if not (CONFIGURATION / f"env/{name}.yaml").exists():
            library, _, short = name.partition("_")
            path = f"mujoco/{short}" if library == "mujoco" else f"beyond/{name}"
            yield f"env/{path}", name, system
    for name, policy in POLICIES.items():
        if not (CONFIGURATION / f"policy/{name}.yaml").exists():
            folder = "baseline" if issubclass(policy, OpenLoop) else "beyond"
            yield f"policy/{folder}/{name}", name, policy
    for name, task in TASKS.items():
        yield f"task/{name}", name, task


def _section(name: str, cls: type) -> dict[str, object]:
    fields = {field.name: field.default for field in dataclasses.fields(cls)}
    listed = {key: list(v) if isinstance(v, tuple) else v for key, v in fields.items()}
    return {"name": name, **listed}
