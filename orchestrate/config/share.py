"""Setting ``launch.share``: the part of a grid that one of several launches runs."""

from __future__ import annotations

import re
from dataclasses import dataclass

from orchestrate.config.value_checks import wrong

_SHARE = re.compile(r"(\d+)/(\d+)")


@dataclass(frozen=True)
class Share:
    """Share ``number``, from 1 on, of ``count`` shares of a grid.

    Each trial belongs to one share, whatever else the grid holds.
    """

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}-of-{self.count}"

    def holds(self, trial_key: str) -> bool:
        """Return whether a trial belongs to the share; its key is a hash."""
        return int(trial_key[:12], 16) % self.count == self.number - 1


def share(value: object) -> Share | None:
    """Return the share that a setting such as ``3/20`` names, or None for the whole grid.

    Raises
    ------
    LaunchError
        If the setting names no share.
    """
    if value is None:
        return None
    found = _SHARE.fullmatch(value) if isinstance(value, str) else None
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise wrong("launch.share", value, "null or a share I/N with I from 1 to N, such as 3/20,")
    return Share(int(found[1]), int(found[2]))
