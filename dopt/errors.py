"""Errors of the package; each message says what was given, what was expected, what to do."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import SequenceMatcher

DISTRIBUTION = "dopt-exploration"
"""Name of this package for pip, which knows another project by the name of the import."""

SIMILAR = 0.5
"""Names at least so similar, from 0 to 1, are suggested."""


class DoptError(Exception):
    """Base of the package's own errors."""


class SpecificationError(DoptError, ValueError):
    """A trial was described with an unknown name, a wrong type or a value outside its bounds."""


class IncompatibleError(SpecificationError):
    """Two valid choices that make no sense together, such as a periodic input without a mode."""


class ExplorationError(DoptError, RuntimeError):
    """An exploration of a plant cannot go on, or was asked for out of order."""


class UnusableEnvironmentError(DoptError, RuntimeError):
    """Variables, folders or limits of the process let no trial run: that is no trial's failure."""


class ScaleWarning(UserWarning):
    """The quantities that a network is to learn are of another size than its outputs."""


def install_command(extra: str) -> str:
    """Return the command that adds the libraries of an extra to this installation."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def unknown_name(kind: str, given: object, valid: Iterable[str]) -> SpecificationError:
    """Return the error for an unknown name, with the nearest valid one if any is near."""
    names = sorted(valid)
    if not names:
        return SpecificationError(f"{kind} '{given}' is unknown, no {kind} exists: remove it.")
    return SpecificationError(f"{kind} '{given}' is unknown: {suggestion(str(given), names)}")


def suggestion(given: str, valid: Iterable[str]) -> str:
    """Return what to write in place of a name: the nearest one, if one is similar, then all."""
    names = list(valid)
    near = max(names, key=lambda name: (*_similarity(given, name), name))
    if max(_similarity(given, near)) < SIMILAR:
        return f"choose one of {', '.join(names)}."
    return f"did you mean '{near}'? Choose one of {', '.join(names)}."


def _similarity(given: str, name: str) -> tuple[float, float]:
    """Return how similar two names are at best, and as a whole, from 0 to 1.

    Of names in folders, such as ``beyond/exact``, the last parts are compared too: the folder may
    be missing, or another one.
    """
    whole = SequenceMatcher(None, name, given).ratio()
    last = SequenceMatcher(None, name.rpartition("/")[2], given.rpartition("/")[2]).ratio()
    return max(whole, last), whole
