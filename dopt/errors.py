"""Errors of the package; each message is one sentence: what was given, what was expected."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import SequenceMatcher

SIMILAR = 0.5
"""Names at least so similar, from 0 to 1, are suggested."""


class DoptError(Exception):
    """Base of the package's own errors."""


class SpecificationError(DoptError, ValueError):
    """A trial was described with an unknown name, a wrong type or a value outside its bounds."""


class IncompatibleError(SpecificationError):
    """Two valid choices that make no sense together, such as a periodic input without a mode."""


class ScaleWarning(UserWarning):
    """The quantities that a network is to learn are of another size than its outputs."""


def unknown_name(kind: str, given: object, valid: Iterable[str]) -> SpecificationError:
    """Return the error for an unknown name, with the nearest valid one if any is near."""
    names = sorted(valid)
    if not names:
        return SpecificationError(
            f"{kind} '{given}' is unknown, there is none to set: leave it out."
        )
    near = max(names, key=lambda name: (*_similarity(str(given), name), name))
    similar = max(_similarity(str(given), near)) >= SIMILAR
    hint = f"did you mean '{near}'?" if similar else "choose one of these."
    return SpecificationError(
        f"{kind} '{given}' is unknown, valid names are {', '.join(names)}: {hint}"
    )


def _similarity(given: str, name: str) -> tuple[float, float]:
    """Return how similar two names are at best, and as a whole, from 0 to 1.

    Of names in folders, such as ``beyond/exact``, the last parts are compared too: the folder may
    be missing, or another one.
    """
    whole = SequenceMatcher(None, name, given).ratio()
    last = SequenceMatcher(None, name.rpartition("/")[2], given.rpartition("/")[2]).ratio()
    return max(whole, last), whole
