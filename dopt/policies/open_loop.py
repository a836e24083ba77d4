"""Open-loop policies: random inputs, and the signals of classical identification."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.base import Array, OpenLoop, on_sphere
from dopt.systems.base import System
from dopt.systems.properties import eigenmode


@dataclass(frozen=True, kw_only=True)
class RandomGaussian(OpenLoop):
    """u_t ~ N(0, (γ²/m) I), the paper's random policy (section 3).

    Its mean energy is γ²; single inputs exceed the bound, as in the paper's own definition.
    """

    name: ClassVar[str] = "random"
    exceeds: ClassVar[bool] = True

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        shape = (system.horizon, system.n_inputs)
        deviation = system.gamma / math.sqrt(system.n_inputs)
        return deviation * rng.standard_normal(shape)


@dataclass(frozen=True, kw_only=True)
class RandomSphere(OpenLoop):
    """u_t uniform on the sphere ‖u‖ = γ, independent from step to step."""

    name: ClassVar[str] = "random_sphere"

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        shape = (system.horizon, system.n_inputs)
        return on_sphere(rng.standard_normal(shape), system.gamma)


@dataclass(frozen=True, kw_only=True)
class RandomHeld(OpenLoop):
    """Uniform on the sphere ‖u‖ = γ, each draw held for a number of steps.

    Parameters
    ----------
    hold : int
        Steps for which an input is held.
    """

    name: ClassVar[str] = "random_held"

    hold: int = parameter(10, "steps", "positive")

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        draws = rng.standard_normal((-(-system.horizon // self.hold), system.n_inputs))
        return np.repeat(on_sphere(draws, system.gamma), self.hold, axis=0)[: system.horizon]


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

    The mean square of the inputs over whole periods is γ²/2, half as much as for inputs of norm γ:
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

    Every input has the norm γ, so that the mean square of the inputs is γ², as for D-optimal
    ones. With the eigenfrequency it is one of the sequences of which the reachable set is made
    (:func:`dopt.evaluation.reachable_states`), except at the steps where the sine is zero.

    Parameters
    ----------
    frequency : float or None
        As of :class:`AtEigenfrequency`.
    """

    name: ClassVar[str] = "periodic_square"

    def wave(self, phase: Array) -> Array:
        return np.where(np.sin(phase) >= 0.0, 1.0, -1.0)


@dataclass(frozen=True, kw_only=True)
class PRBS(OpenLoop):
    """Every component is ±γ/√m, by a shift register of maximal length; the seed gives the phase.

    The register is the shortest whose period, 2ⁿ - 1 clocks, is not shorter than the trial and has
    a place for each input. Input j of m is the same sequence a j-th of the period later: sequences
    so shifted are uncorrelated.
    Reference: L. Ljung, "System identification: theory for the user", 2nd ed., section 13.3 (1999).

    Parameters
    ----------
    hold : int
        Steps for which each value is held: the clock of the register.
    """

    name: ClassVar[str] = "prbs"

    hold: int = parameter(10, "steps", "positive")

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        from scipy.signal import max_len_seq  # its import takes longer than a short trial

        clocks = -(-system.horizon // self.hold)
        m = system.n_inputs
        bits, _ = max_len_seq(max(2, math.ceil(math.log2(max(clocks, m) + 1))))
        signs = 2.0 * bits - 1.0
        starts = rng.integers(len(signs)) + np.arange(m) * len(signs) // m
        sequence = signs[(np.arange(clocks)[:, None] + starts) % len(signs)]
        return np.repeat(system.gamma / math.sqrt(m) * sequence, self.hold, axis=0)[
            : system.horizon
        ]


@dataclass(frozen=True, kw_only=True)
class Multisine(OpenLoop):
    """Harmonics of the trial's length, of equal power up to a share of the Nyquist frequency.

    Input j of m has harmonics j, j + m, j + 2m ..., so that no two inputs share a frequency. The
    phases are Schroeder's, which keep the peaks low; the seed gives the start. The whole is scaled
    so that its largest norm is γ. References: M. Schroeder, "Synthesis of low-peak-factor signals",
    IEEE Trans. Inf. Theory 16 (1970); R. Pintelon and J. Schoukens, "System identification: a
    frequency domain approach", 2nd ed. (2012).

    Parameters
    ----------
    band : float
        Highest frequency as a share of the Nyquist frequency 1/(2 dt).
    """

    name: ClassVar[str] = "multisine"

    band: float = parameter(0.1, "1", "share")

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        T, m = system.horizon, system.n_inputs
        highest = max(m, int(self.band * T / 2))
        time = np.arange(T) + rng.uniform(0, T)
        waves = np.stack([_wave(np.arange(1 + j, highest + 1, m), time / T) for j in range(m)], 1)
        scaled: Array = system.gamma / np.linalg.norm(waves, axis=1).max() * waves
        return scaled


def _wave(harmonics: np.ndarray[tuple[int], np.dtype[np.int64]], turns: Array) -> Array:
    """Return the sum of cosines of some harmonics at a share of the period, (T,)."""
    count = len(harmonics)
    place = np.arange(1, count + 1)
    phases = -np.pi * place * (place - 1) / count
    total: Array = np.cos(2 * np.pi * np.outer(turns, harmonics) + phases).sum(axis=1)
    return total


@dataclass(frozen=True, kw_only=True)
class Chirp(OpenLoop):
    """u_j = √(2/m) γ cos(ψ(t) + π j/m), whose frequency rises linearly from zero over the trial.

    For m ≥ 2 the norm is γ at every step; for m = 1 it is u = γ cos ψ. The seed gives the phase at
    the start. Reference: R. Pintelon and J. Schoukens, "System identification: a frequency domain
    approach", 2nd ed., chapter 5 (2012), swept sine.

    Parameters
    ----------
    band : float
        Frequency at the end as a share of the Nyquist frequency 1/(2 dt).
    """

    name: ClassVar[str] = "chirp"

    band: float = parameter(0.1, "1", "share")

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        T, m = system.horizon, system.n_inputs
        time = np.arange(T)
        phase = rng.uniform(0, 2 * np.pi) + np.pi / 2 * self.band * time**2 / T
        size = system.gamma * math.sqrt(2 / m if m > 1 else 1)
        waves: Array = size * np.cos(phase[:, None] + np.pi * np.arange(m) / m)
        return waves
