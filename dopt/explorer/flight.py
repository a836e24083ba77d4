"""Inputs of a plant that come late, slowly or cut, as an exploration follows them.

The learner is told what acts in the plant during a step, and plans are made for the state that is
predicted for the moment at which their input arrives. What was asked before the first state, or
before a reset, is taken for 0. In a gap the last input is held as long as the gap lasts, or if that
is not known, until nothing else is on the way.
"""

from __future__ import annotations

import collections
import math

import numpy as np

from dopt.systems.base import System
from dopt.systems.plant import ExploredPlant
from dopt.types import Array

REMEMBERED = 1000
"""Inputs that are kept for another delay or lag; what was before the first is taken for it."""

SETTLED = 40.0
"""Time constants of the lag after which nothing is left of an earlier input in a double."""


class InFlight:
    """Inputs on their way to the plant of an exploration.

    Parameters
    ----------
    system : System
        Inputs of a system that was not made of a :class:`dopt.Plant` act at once.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self.reset()

    def reset(self) -> None:
        """Take all inputs so far for 0."""
        system = self._system
        self._flight = system.flight() if isinstance(system, ExploredPlant) else None
        self._last = np.zeros(system.n_inputs)
        self._departed = collections.deque([self._last], maxlen=REMEMBERED)

    def retimed(self, system: ExploredPlant) -> InFlight:
        """Return the same inputs on their way to a plant with another delay or lag."""
        other = InFlight(system)
        if other._flight is not None:
            other._flight.settle(self._departed[0])
            for u in self._departed:
                other._flight.depart(u)
        other._last, other._departed = self._last, self._departed
        return other

    def cut(self, u: Array) -> Array:
        """Return what the supply can apply of an input, (m,)."""
        limit = self._system.cut_at
        return u if limit == math.inf else np.clip(u, -limit, limit)

    def depart(self, u: Array) -> Array:
        """Let an input depart, and return what acts in the step that begins with it, (m,)."""
        if self._flight is None:
            return u
        self._last = u
        self._departed.append(u)
        return self._flight.depart(u)

    def hold(self, u: Array | None, seconds: float | None) -> None:
        """Let an input, (m,), or the last one, be held for a time [s]; for long if it is None."""
        if self._flight is None:
            return
        self._last = self._last if u is None else self.cut(u)
        dt = self._system.dt
        longest = len(self._flight.inputs) + math.ceil(SETTLED * self._flight.lag / dt)
        steps = math.inf if seconds is None else seconds / dt
        if steps >= longest:
            self._flight.settle(self._last)
            self._departed.clear()
            self._departed.append(self._last)
            return
        for _ in range(round(steps)):
            self.depart(self._last)

    def ahead(self) -> tuple[Array, Array] | None:
        """Return what acts until an input that departs now arrives, (n, m), and how long [s], (n,).

        None where that acts at once.
        """
        return self._flight.ahead() if self._flight and self._flight.inputs else None

    def acted(self, inputs: Array) -> Array:
        """Return what acted in a run, (T, m), before which its first input was held."""
        cut = self.cut(inputs)
        if self._flight is None or not len(inputs):
            return cut
        run = InFlight(self._system)
        run.hold(cut[0], None)
        return np.array([run.depart(u) for u in cut])
