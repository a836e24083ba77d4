"""Axes of a grid: one for each override, with its values."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Literal

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override, OverrideType, QuotedString
from hydra.errors import ConfigCompositionException

from dopt.errors import SpecificationError, suggestion, unknown_name
from orchestrate.config.globs import every_option, matches

NOT_SWEPT = ("launch", "store", "executor", "experiment", "hydra")
"""Groups and sections of the whole launch, which cannot be swept."""

MAX_VALUES = 1_000_000
"""Largest number of values of one sweep, so that a mistyped range does not fill the memory."""


@dataclasses.dataclass(frozen=True)
class Axis:
    """Key of an override and its values.

    Attributes
    ----------
    key
        Configuration key or group as typed, with its prefix ``+``, ``++`` or ``~`` and its package.
    texts
        The values as Hydra would write them after the equals sign.
    values
        The values, typed by Hydra's grammar.
    kind
        ``choice`` of a group, ``scalar`` that replaces a value, or ``edit``: any other change of
        the composed configuration, such as ``+k=1``, a list or a deletion.
    """

    key: str
    texts: tuple[str, ...]
    values: tuple[object, ...]
    kind: Literal["choice", "scalar", "edit"]

    @property
    def swept(self) -> bool:
        return len(self.texts) > 1

    @property
    def replaces(self) -> bool:
        """Whether the override sets an existing key: not a group, and without ``+`` or ``~``."""
        return self.kind != "choice" and self.key[0] not in "+~"

    def argument(self, index: int) -> str:
        """Return the override that sets value ``index``."""
        return f"{self.key}={self.texts[index]}"


def read_axes(loader: ConfigLoader, arguments: Sequence[str]) -> list[Axis]:
    """Return the axes that the overrides span; a later override of a key replaces an earlier one.

    Raises
    ------
    HydraException
        If an override does not follow Hydra's grammar, or its sweep is empty or endless.
    SpecificationError
        If a glob matches nothing.
    """
    parsed = OverridesParser.create(config_loader=loader).parse_overrides(list(arguments))
    last = {override.get_key_element(): override for override in parsed}
    axes = [_axis(loader, override) for override in last.values()]
    return [_without_clash(axis, axes) for axis in axes]


def _axis(loader: ConfigLoader, override: Override) -> Axis:
    key = override.get_key_element()
    texts: tuple[str, ...]
    values: tuple[object, ...]
    value: object = override.value()
    if not override.is_sweep_override():
        texts, values = (override.get_value_element_as_str(),), (value,)
    elif isinstance(value, Glob):
        _check_key(override)
        texts = values = matches(loader, override.key_or_group, value)
        if not texts:
            raise _no_match(loader, override, value)
    else:
        _check_key(override)
        _check_count(override)
        texts = tuple(override.sweep_string_iterator())
        values = tuple(_unquoted(value) for value in override.sweep_iterator())
    options = _options(loader, override.key_or_group)
    if options and not any(isinstance(value, dict) for value in values):
        if None in values:
            raise unknown_name(override.key_or_group, "null", options)
        return Axis(key, texts, values, "choice")
    scalar = override.type == OverrideType.CHANGE and override.package is None
    return Axis(key, texts, values, "scalar" if scalar and all(map(_plain, values)) else "edit")


def _options(loader: ConfigLoader, group: str) -> list[str]:
    """Return the options of a group; the loader itself copies all of its sources to find them."""
    source = loader.repository if isinstance(loader, ConfigLoaderImpl) else loader
    return source.get_group_options(group, results_filter=None)


def _check_key(override: Override) -> None:
    if override.key_or_group.replace("/", ".").split(".")[0] in NOT_SWEPT:
        raise ConfigCompositionException(
            f"'{override.input_line}' sweeps a setting of the launch, but only settings of trials "
            "can be swept: give one value."
        )


def _check_count(override: Override) -> None:
    line = override.input_line
    if not override.is_discrete_sweep():
        raise ConfigCompositionException(
            f"'{line}' has no finite list of values: use a choice a,b or range(start,stop,step)."
        )
    count = sum(1 for _ in itertools.islice(override.sweep_iterator(), MAX_VALUES + 1))
    if count == 0:
        raise ConfigCompositionException(
            f"'{line}' has no values, at least one is expected: check its bounds."
        )
    if count > MAX_VALUES:
        raise ConfigCompositionException(
            f"'{line}' has more than {MAX_VALUES:,} values: check its bounds, or sweep in parts."
        )


def _no_match(loader: ConfigLoader, override: Override, glob: Glob) -> Exception:
    key = override.key_or_group
    if options := every_option(loader, key):
        pattern = ",".join(glob.include)
        hint = suggestion(pattern, sorted(options))
        return SpecificationError(f"no name of {key} matches the pattern '{pattern}': {hint}")
    names = sorted(name for name in loader.list_groups("") if name != "hydra")
    return ConfigCompositionException(
        f"'{override.input_line}' is a glob, but '{key}' is not a group: groups are "
        f"{', '.join(names)}."
    )


def _unquoted(value: object) -> object:
    return value.text if isinstance(value, QuotedString) else value


def _plain(value: object) -> bool:
    """Return whether ``value`` is a plain value, with no interpolation."""
    if isinstance(value, str):
        return "${" not in value and value != "???"
    return value is None or isinstance(value, bool | int | float)


def _without_clash(axis: Axis, axes: Sequence[Axis]) -> Axis:
    """Turn a scalar into an edit if another override changes the same part of the tree."""
    edits = (other for other in axes if other is not axis and other.kind != "choice")
    if axis.kind == "scalar" and any(_overlap(axis.key, other.key) for other in edits):
        return dataclasses.replace(axis, kind="edit")
    return axis


def _overlap(one: str, other: str) -> bool:
    pairs = zip(_path(one), _path(other), strict=False)
    return all(a == b for a, b in pairs)


def _path(key: str) -> list[str]:
    return key.lstrip("+~").split("@")[0].split(".")
