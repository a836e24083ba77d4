"""Setting ``launch.until``: the rule by which a configuration gets no more seeds."""

from __future__ import annotations

import re
from dataclasses import dataclass

from orchestrate.config.value_checks import wrong

_PRECISE = re.compile(r"ci\s*<\s*(\d+(?:\.\d+)?)\s*%")
_EXPECTED = (
    "null, decided (each comparison with the reference is decided) or ci<P% with P above 0 and "
    "below 100 (the geometric mean of the final loss is known to within P percent), such as "
    "'ci<5%',"
)


@dataclass(frozen=True)
class UntilDecided:
    """Until every comparison with the reference is decided."""


@dataclass(frozen=True)
class UntilPrecise:
    """Until the geometric mean of the final loss is known to within a factor 1 + ``relative``."""

    relative: float


Until = UntilDecided | UntilPrecise


def until(value: object) -> Until | None:
    """Return the rule that a setting names; None for the one that runs all seeds.

    Raises
    ------
    LaunchError
        If the setting names no rule.
    """
    if value is None:
        return None
    if value == "decided":
        return UntilDecided()
    match = _PRECISE.fullmatch(value.strip()) if isinstance(value, str) else None
    if match and 0 < float(match[1]) < 100:
        return UntilPrecise(float(match[1]) / 100)
    raise wrong("launch.until", value, _EXPECTED)
