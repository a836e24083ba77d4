"""Every error that the package raises on purpose; each message is one sentence that helps."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class DoptError(Exception):
    """Base of the package's own errors."""


class SpecificationError(DoptError, ValueError):
    """A trial was described with an unknown name, a wrong type or a value outside its bounds."""


class IncompatibleError(SpecificationError):
    """Two valid choices that make no sense together, such as a periodic input without a mode."""


def unknown_name(kind: str, given: object, valid: Iterable[str]) -> SpecificationError:
    """Return the error for an unknown name, with the nearest valid one."""
    names = sorted(valid)
    if not names:
        return SpecificationError(
            f"{kind} '{given}' is unknown, there is none to set: leave it out."
        )
    near = difflib.get_close_matches(str(given), names, n=1, cutoff=0.5)
    hint = f"did you mean '{near[0]}'?" if near else "choose one of these."
    return SpecificationError(
        f"{kind} '{given}' is unknown, valid names are {', '.join(names)}: {hint}"
    )
