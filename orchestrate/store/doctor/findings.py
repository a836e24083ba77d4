"""What an examination of a database finds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One thing that is not as it should be.

    Attributes
    ----------
    severity
        "error" where results cannot be trusted, "warning" where an analysis may mislead, "note"
        where nothing is lost.
    sentence
        What was found.
    count
        How often.
    advice
        What to do about it.
    """

    severity: Severity
    sentence: str
    count: int
    advice: str


def found(severity: Severity, what: str, count: int, first: object, advice: str) -> Finding:
    """Return a finding of several things of a kind, of which one is named."""
    return Finding(severity, f"{what}: {count:,} (the first is {first})", count, advice)
