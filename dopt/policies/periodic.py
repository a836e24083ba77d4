"""Periodic inputs at the eigenfrequency of the system."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.base import Array, OpenLoop
from dopt.systems.base import System
from dopt.systems.properties import eigenmode


@dataclass(frozen=True, kw_only=True)
class AtEigenfrequency(OpenLoop):
    """u_t = γ wave(ω t dt) e, with e the input direction that drives the mode most.

    Parameters
    ----------
    frequency : float or None
        Angular frequency ω [rad/s]; None takes the damped eigenfrequency of the least damped
        oscillation about the stable equilibrium. A system without such an oscillation, with one
        input, needs it.
    """

    frequency: float | None = parameter(None, "rad/s", "positive")

    @abstractmethod
    def wave(self, phase: Array) -> Array:
        """Return the values, (T,), between -1 and 1, at phases, (T,) [rad]."""

    def check(self, system: System) -> None:
        if self._wave_of(system) is None:
            ways = "choose another policy"
            if system.n_inputs == 1:
                ways = f"set policy.frequency, or {ways}"
            raise IncompatibleError(
                f"policy '{self.name}' needs an eigenmode, but env '{system.name}' with these "
                f"parameters has no oscillation about a stable equilibrium: {ways}."
            )

    def _wave_of(self, system: System) -> tuple[float, Array] | None:
        """Return ω and e, (m,), if they are known."""
        mode = eigenmode(system)
        if mode is not None:
            return mode.frequency if self.frequency is None else self.frequency, mode.direction
        if self.frequency is not None and system.n_inputs == 1:
            return self.frequency, np.ones(1)
        return None

    def inputs(self, system: System, rng: np.random.Generator) -> Array:  # noqa: ARG002  # nothing is random here
        known = self._wave_of(system)
        assert known is not None, "check() is called before"
        frequency, direction = known
        times = system.dt * np.arange(system.horizon)
        phase = np.asarray(frequency * times, np.float64)
        inputs: Array = system.gamma * self.wave(phase)[:, None] * direction
        return inputs


@dataclass(frozen=True, kw_only=True)
class Periodic(AtEigenfrequency):
    """u_t = γ sin(ω t dt) e (section 3), with e the input direction that drives the mode most.

    The mean square of the inputs over whole periods is γ²/2, half that of inputs of norm γ:
    ``periodic_square`` (:class:`PeriodicSquare`) has the same frequency and direction, and γ².

    Parameters
    ----------
    frequency : float or None
        As of :class:`AtEigenfrequency`.
    """

    name: ClassVar[str] = "periodic"

    def wave(self, phase: Array) -> Array:
        return np.sin(phase)


@dataclass(frozen=True, kw_only=True)
class PeriodicSquare(AtEigenfrequency):
    """u_t = ±γ e with the sign of sin(ω t dt), + at zero: the square wave of :class:`Periodic`.

    Every input has the norm γ, so that the mean square of the inputs is γ², as that of D-optimal
    ones. With the eigenfrequency it is one of the sequences of which the reachable set is made
    (:func:`dopt.evaluation.reachable_states`), but for the steps where the sine is zero.

    Parameters
    ----------
    frequency : float or None
        As of :class:`AtEigenfrequency`.
    """

    name: ClassVar[str] = "periodic_square"

    def wave(self, phase: Array) -> Array:
        return np.where(np.sin(phase) >= 0.0, 1.0, -1.0)
