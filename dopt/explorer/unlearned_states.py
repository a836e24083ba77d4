"""Count of states in a row from which nothing was learned, with one warning when they are many."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from dopt.explorer.journal import Event

MANY = 20
"""States in a row from which nothing was learned that are said."""

_log = logging.getLogger("dopt.explorer")


class UnlearnedStates:
    """States since the last one that was learned from, by the events of an exploration.

    Parameters
    ----------
    dt : float
        Time from one state to the next that is expected [s].
    """

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self._in_a_row = 0

    def note(self, event: Event, counts: Mapping[str, int]) -> None:
        """Count the state of an event; warn at the ``MANY``-th, with the counts of all states."""
        if "learn" in event:
            self._in_a_row = 0
            return
        if not event.keys().isdisjoint(("plan", "missed")) or event.get("lost") == "resets":
            return
        self._in_a_row += 1
        if self._in_a_row == MANY:
            _log.warning(
                "nothing was learned from the last %d states (%s), but states are expected every "
                "%g s: tell() each state that followed an input, give times in seconds, call "
                "reset() if their clock began anew, and give a limit that no state is beyond, and "
                "a policy and a learner that are faster than that",
                *(MANY, counts, self._dt),
            )
