"""Error messages of one line, with the nearest valid name: Hydra's and those on unknown keys."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import cast

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
from orchestrate.cli_parser import removed_word
from orchestrate.config.options import CONFIGURATION, option_names

KNOWN = (
    "env",
    "policy",
    "model",
    "learner",
    "task",
    "limits",
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
    _check("launch", launch["launch"], _read(CONFIGURATION / "config.yaml").get("launch"))
    _check("store", launch["store"], dict.fromkeys(("url", "folder", "every")))
    _check("executor", executor, _read(CONFIGURATION / "executor" / f"{name}.yaml"))


def _check(path: str, given: object, known: object) -> None:
    if not isinstance(given, Mapping) or not isinstance(known, Mapping) or not known:
        return
    for key, value in given.items():
        if key not in known:
            raise unknown_name(f"setting of {path}", key, map(str, known))
        _check(f"{path}.{key}", value, known[key])


def _read(path: Path) -> dict[str, object]:
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
