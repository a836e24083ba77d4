"""Options of the groups of a launch, and error messages with the nearest valid one.

A file holds the paper's systems and policies with the reasons for their numbers, and whatever
chooses more than one part. Every other system and policy is an option with the defaults of its
class, whose docstring gives units and reasons: ``env=beyond/chain``, ``policy=baseline/prbs``.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from hydra.core.config_store import ConfigStore
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from dopt.errors import DoptError, SpecificationError, unknown_name
from dopt.registry import TARGET, imported
from orchestrate.program import removed_word

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


KNOWN = (
    "env",
    "plant",
    "policy",
    "model",
    "learner",
    "task",
    "limits",
    "assess",
    "seed",
    "width",
    "launch",
    "store",
    "executor",
)
"""Top-level keys that a launch reads, beside Hydra's own."""

_NOT_SETTABLE = ("hydra", "name", TARGET)
"""Keys that messages do not suggest."""

_SEVERAL = re.compile(r"(?:Ambiguous value for argument|Sweep parameters) ('.*?')(?: requires|\n)")

_OPTION = re.compile(r"(hydra/[^/]+|[^/]+)/(.+)")
"""Group and option; groups of Hydra itself have two parts."""

_BARE = re.compile(r"[^=]+")
_NOISE = re.compile(r"\s*(\^|See https?:|full_key:|object_type=|reference_type=|To append |$)")


def format_error(error: Exception) -> str:
    """Return one line: the given value, the expected one, and the remedy."""
    if isinstance(error, DoptError):
        return _one_line(str(error))
    if isinstance(error, MissingConfigException) and error.options:
        return _unknown_option(str(error.missing_cfg_file), error.options)
    if isinstance(error, OverrideParseException) and _BARE.fullmatch(error.override):
        return f"'{error.override}' is not an override: write key=value, such as env=arm."
    if isinstance(error, OverrideParseException):
        return _one_line(f"cannot read the override '{error.override}': {error.message}")
    if match := _SEVERAL.search(str(error)):
        return f"{match[1]} gives several values to one trial: add -m for a grid, or quote it."
    if str(error).startswith("Config group override must be"):
        return (
            "the option of a group is a number, but one of its names is expected: write for "
            "instance env=pendulum or policy=d_optimal."
        )
    cause = error.__cause__ if isinstance(error, ConfigCompositionException) else error
    if isinstance(cause, ConfigAttributeError | ConfigKeyError) and cause.full_key:
        return _unknown_key(cause)
    if isinstance(cause, OmegaConfBaseException) and cause is not error:
        return _one_line(f"{error} {cause}")
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _one_line(str(error))
    return _one_line(f"{type(error).__name__}: {error} (HYDRA_FULL_ERROR=1 shows the traceback)")


def _unknown_option(given: str, options: Iterable[str]) -> str:
    """Return the message for an option without a configuration file.

    In ``policy/beyond/exact`` the group is ``policy``: folders in it are part of the option.
    """
    match = _OPTION.fullmatch(given)
    group, option = match.groups() if match else ("", given)
    if sentence := removed_word(f"{group}={option}"):
        return sentence
    return str(unknown_name(group or "configuration", option, {*options, *option_names(group)}))


def _unknown_key(cause: OmegaConfBaseException) -> str:
    parent, key = cause.parent_node, str(cause.full_key)
    names = [str(name) for name in parent] if isinstance(parent, DictConfig) else []
    if isinstance(parent, DictConfig) and TARGET in names:
        return str(unknown_field(key, str(parent[TARGET]), names))
    return str(unknown_setting(key, names))


def check_launch(launch: Mapping[str, object]) -> None:
    """Refuse an unknown setting of the launch, its store or its executor.

    Parameters
    ----------
    launch
        The sections ``launch``, ``store`` and ``executor`` in plain types.
    """
    executor = launch["executor"]
    name = executor.get("name") if isinstance(executor, Mapping) else None
    _check("launch", launch["launch"], content_of(CONFIGURATION / "config.yaml").get("launch"))
    _check("store", launch["store"], dict.fromkeys(("url", "folder", "every")))
    _check("executor", executor, content_of(CONFIGURATION / "executor" / f"{name}.yaml"))


def _check(path: str, given: object, known: object) -> None:
    if not isinstance(given, Mapping) or not isinstance(known, Mapping) or not known:
        return
    for key, value in given.items():
        if key not in known:
            raise unknown_name(f"setting of {path}", key, map(str, known))
        _check(f"{path}.{key}", value, known[key])


@functools.cache
def content_of(path: Path) -> Mapping[str, Any]:
    """Return the content of a file; empty for an option outside this folder."""
    content = OmegaConf.to_container(OmegaConf.load(path)) if path.is_file() else {}
    return {str(key): value for key, value in content.items()} if isinstance(content, dict) else {}


def unknown_setting(key: str, names: Iterable[str]) -> SpecificationError:
    """Return the error for a dotted key, with the nearest of the names in its place."""
    holder, _, last = key.rpartition(".")
    settable = [name for name in names if name not in _NOT_SETTABLE]
    return unknown_name(f"setting of {holder}" if holder else "setting", last, settable)


def unknown_field(key: str, target: str, names: Iterable[str]) -> SpecificationError:
    """Return the error for a key of a custom class.

    Parameters
    ----------
    key
        Dotted key, such as ``env.mass``.
    target
        Dotted path of the class.
    names
        Keys of the section in its configuration file, where a field may be missing.
    """
    holder, _, last = key.rpartition(".")
    try:
        fields = inspect.signature(cast("type", imported(holder, target))).parameters
    except SpecificationError as error:
        return error
    if last in fields:
        return SpecificationError(
            f"'{key}' is a field of {target}, but its configuration file does not set it: "
            f"add it with +{key}=."
        )
    return unknown_setting(key, {*names, *fields})


def _one_line(text: str) -> str:
    """Join the lines, without pointers, links and repetitions."""
    return " ".join(line.strip() for line in text.splitlines() if not _NOISE.match(line)).strip()
