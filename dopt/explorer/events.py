"""Events that a journal may hold: their entries, and the numbers in each."""

from __future__ import annotations

import math
from contextlib import suppress

from dopt.errors import SpecificationError
from dopt.explorer.arguments import finite, seconds, within
from dopt.explorer.journal import Event

_ENTRIES = {
    "learn": ("learn", "applied", "dt", "time"),
    "plan": ("plan",),
    "missed": ("missed",),
    "begin": ("begin", "time"),
    "gap": ("gap", "time"),
    "lost": ("lost",),
    "counted": ("counted",),
}
_NAMES = {"lost": ("unusable", "resets"), "counted": ("repeated", "out_of_order")}
_INPUTS = ("applied", "plan", "missed")


def is_event(event: Event, n_states: int, n_inputs: int) -> bool:
    """Tell whether an event has the entries of its kind, and finite numbers in them."""
    entries = next((entries for kind, entries in _ENTRIES.items() if kind in event), ())
    if not entries or not event.keys() >= set(entries):
        return False
    with suppress(SpecificationError):
        for entry in entries:
            if entry in _NAMES:
                return event[entry] in _NAMES[entry]
            if entry == "dt":
                within(entry, event[entry], math.inf)
            elif entry == "time":
                seconds(event[entry])
            else:
                finite(entry, event[entry], n_inputs if entry in _INPUTS else n_states)
        return True
    return False
