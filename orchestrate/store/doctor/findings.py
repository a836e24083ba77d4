"""Finding of a consistency check."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "note"]

REBUILD = (
    "merge this database into a new one, which leaves such trials out (python -m orchestrate merge "
    "THIS --db NEW), and run the same launch into that one"
)


@dataclass(frozen=True)
class Finding:
    """Result of a consistency check.

    Attributes
    ----------
    severity
        "error" if results cannot be trusted, "note" if nothing is lost.
    sentence
        Description.
    count
        Number of occurrences.
    advice
        Remedy.
    """

    severity: Severity
    sentence: str
    count: int
    advice: str


def found(severity: Severity, what: str, count: int, first: object, advice: str) -> Finding:
    """Return a finding of several objects of a kind, with the name of the first."""
    return Finding(severity, f"{what}: {count:,} (the first is {first})", count, advice)
