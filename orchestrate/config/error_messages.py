"""What Hydra complains about, said in one sentence with the nearest valid name."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from dopt.errors import DoptError, unknown_name
from dopt.registry import TARGET

_SEVERAL = re.compile(r"(?:Ambiguous value for argument|Sweep parameters) ('.*?')(?: requires|\n)")
CONFIGURATION = Path(__file__).resolve().parents[2] / "conf"

_OPTION = re.compile(r"(hydra/[^/]+|[^/]+)/(.+)")
"""A group, those of Hydra itself have two parts, and what is chosen of it."""

_BARE = re.compile(r"[^=]+")
_NOISE = re.compile(r"\s*(\^|See https?:|full_key:|object_type=|reference_type=|To append |$)")


def sentence_for(error: Exception) -> str:
    """Return one line that says what was given, what was expected and what to do."""
    if isinstance(error, DoptError):
        return _one_line(str(error))
    if isinstance(error, MissingConfigException) and error.options:
        return _unknown_option(str(error.missing_cfg_file), error.options)
    if isinstance(error, OverrideParseException) and _BARE.fullmatch(error.override):
        return f"'{error.override}' is no setting: write key=value, such as env=pendulum or seed=3."
    if isinstance(error, OverrideParseException):
        return _one_line(f"cannot read the override '{error.override}': {error.message}")
    if match := _SEVERAL.search(str(error)):
        return f"{match[1]} gives several values to one trial: add -m for a grid, or quote it."
    if str(error).startswith("Config group override must be"):
        return (
            "the choice of a group is a number, but the name of one of its options is expected: "
            "write for instance env=pendulum or policy=d_optimal."
        )
    cause = error.__cause__ if isinstance(error, ConfigCompositionException) else error
    if isinstance(cause, ConfigAttributeError | ConfigKeyError) and cause.full_key:
        return _unknown_key(cause)
    if isinstance(cause, OmegaConfBaseException) and cause is not error:
        return _one_line(f"{error} {cause}")
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _one_line(str(error))
    return _one_line(f"{type(error).__name__}: {error} (HYDRA_FULL_ERROR=1 shows where it arose)")


def _unknown_option(given: str, options: Iterable[str]) -> str:
    """Return the sentence for a path that is no file of the configuration.

    In ``policy/beyond/exact`` the group is ``policy``: folders in it are part of the option.
    """
    match = _OPTION.fullmatch(given)
    group, option = match.groups() if match else ("", given)
    return _unknown(group or "configuration", option, [*options, *_nested(group)])


def _unknown_key(cause: OmegaConfBaseException) -> str:
    parent = cause.parent_node
    names = [str(key) for key in parent] if isinstance(parent, DictConfig) else []
    holder, _, last = str(cause.full_key).rpartition(".")
    names = [name for name in names if name not in ("hydra", "name")]
    if TARGET in names:
        return (
            f"'{cause.full_key}' is not in the configuration of {holder}, a class of your own that "
            f"may have it: add it with +{cause.full_key}=, or set one of "
            f"{', '.join(name for name in names if name != TARGET)}."
        )
    return _unknown(f"setting of {holder}" if holder else "setting", last, names)


def _nested(group: str) -> Iterable[str]:
    """Yield the options in the folders of a group, such as ``baseline/random_held``."""
    folder = CONFIGURATION / group
    for path in folder.glob("*/*.yaml") if group else ():
        yield path.relative_to(folder).with_suffix("").as_posix()


def _unknown(kind: str, given: str, valid: Iterable[str]) -> str:
    return str(unknown_name(kind, given, valid))


def _one_line(text: str) -> str:
    """Join the lines, without those that only point, link or repeat."""
    return " ".join(line.strip() for line in text.splitlines() if not _NOISE.match(line)).strip()
