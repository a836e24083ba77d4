"""Error messages of one line for Hydra's exceptions, with the nearest valid name."""

from __future__ import annotations

import re
from collections.abc import Iterable

from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from dopt.declare.registry import TARGET
from dopt.errors import DoptError, unknown_name
from orchestrate.config.request import CONFIGURATION
from orchestrate.config.unknown_keys import unknown_field, unknown_setting

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
    return str(unknown_name(group or "configuration", option, [*options, *_nested(group)]))


def _unknown_key(cause: OmegaConfBaseException) -> str:
    parent, key = cause.parent_node, str(cause.full_key)
    names = [str(name) for name in parent] if isinstance(parent, DictConfig) else []
    if isinstance(parent, DictConfig) and TARGET in names:
        return str(unknown_field(key, str(parent[TARGET]), names))
    return str(unknown_setting(key, names))


def _nested(group: str) -> Iterable[str]:
    """Yield the options in the folders of a group, such as ``baseline/random_held``."""
    folder = CONFIGURATION / group
    for path in folder.glob("*/*.yaml") if group else ():
        yield path.relative_to(folder).with_suffix("").as_posix()


def _one_line(text: str) -> str:
    """Join the lines, without pointers, links and repetitions."""
    return " ".join(line.strip() for line in text.splitlines() if not _NOISE.match(line)).strip()
