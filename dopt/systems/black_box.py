"""Systems that can be stepped but have no equations, and states that are measured with noise.

A low-pass filter and differences estimate the states. With y_t the measured states,
s = 1 - exp(-2π f_c dt) and f_c the cutoff, the filters of first order are
z_{t+1} = z_t + s (y_{t+1} - z_t) for a measured state and
w_{t+1} = w_t + s ((y_{t+1} - y_t)/dt - w_t) for one that is the rate of a measured state. The
inputs pass through the same filter before they are put with the accelerations of the estimates.

A difference is the rate one step before where the Euler map is simulated, and half a step before
elsewhere. By as much z and the filtered inputs are delayed, so that all of them belong together.
The filters begin at the state from which the steps begin, with inputs of 0; what they give for the
accelerations settles within about 3/(2π f_c) seconds.
"""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError
from dopt.fields import parameter
from dopt.systems.base import Array, System
from dopt.types import Equation, Scalar

ROUNDING = 1e-6
"""Relative difference of two numbers that are the same in single precision."""


class Episode(Protocol):
    """One run of a black box from its start."""

    @property
    def state(self) -> Array:
        """State x_t, (d,)."""

    def step(self, inputs: Array) -> Array:
        """Apply what is possible of an input (m,), and return what was applied, (m,).

        The state is NaN once the run is over. Where a run restarts before the step, in another
        state than the last one, an attribute ``new_start`` holds that state, (d,), until the next.
        """


def new_start(episode: Episode) -> Array | None:
    """Return where the last step of a run began, (d,), if the run had restarted; else None."""
    start: Array | None = getattr(episode, "new_start", None)
    return start


@dataclass(frozen=True, kw_only=True)
class BlackBox(System):
    """A system whose next state comes from somewhere else, such as a simulator.

    Declared are what it is called, which rows of the state derivative are learned, the features and
    the known part: the kinematics and the effect of the inputs, unless the model learns that. All
    of its numbers are observed by differences:
    y_t = (x_{t+1} - x_t)/dt less the known part. There is no process noise but its own, and it
    starts where its reset leaves it, the same for all policies of a seed. A run that ends early is
    one that diverged.

    The interpreter steps it between the compiled steps of a trial, for which ``known`` is compiled;
    with ``compiled = False`` the reference takes the steps. Where ``measured`` is true it is
    explored by what somebody tells of it (:class:`dopt.Explorer`), and no episode of it is begun.

    Where the truth at a state of one's choice is unknown, the loss is the root mean square error
    of the modelled accelerations over transitions of runs of its own, which no trial sees: under
    random inputs for the loss, at most as many as the product of ``grid_points``, and under square
    waves and a chirp for the reachable loss (:func:`dopt.evaluation.evaluation_set`). A simulator
    that can be put into a state tells the truth (:meth:`true_accelerations`), and the loss is that
    over the grid.
    """

    compiled: ClassVar[bool] = True
    measured: ClassVar[bool] = False
    physical: ClassVar[tuple[str, ...]] = ()

    noise: float = parameter(0.0, bound="nonnegative")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.noise:
            raise SpecificationError(
                f"env.noise is {self.noise:g}, but to {self.name} none can be added: leave it out."
            )
        if self.equilibrium is not None:
            raise SpecificationError(
                f"env '{self.name}' declares an equilibrium, but a black box cannot be linearised "
                f"about one: leave it out."
            )

    def _check_size(self, field: str, size: int) -> None:
        if field != "initial_state":
            super()._check_size(field, size)
        elif self.initial_state:
            raise SpecificationError(
                f"env.initial_state is given, but {self.name} starts where its reset leaves it: "
                f"leave it out."
            )

    @abstractmethod
    def episode(self, seed: int) -> Episode:
        """Start a run; the seed decides about all that is random in it."""

    def try_out(self) -> None:
        """Raise SpecificationError if its runs cannot serve trials: begin one and discard it."""
        self.episode(0)

    def true_accelerations(self, states: Array, inputs: Array) -> Array | None:  # noqa: ARG002  # of most, nothing is known
        """Return the accelerations, (N, r), at states (N, d) under inputs (N, m).

        They are those that a step from there would show, less the known part; None if they cannot
        be had.
        """
        return None

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:  # noqa: ARG004
        raise SpecificationError(
            "the true accelerations of a black box are unknown: use what was observed of it, or "
            "another env."
        )


def check_step(system: BlackBox, seconds: float, model: str) -> None:
    """Raise SpecificationError if a step of what runs, with some name, takes another time."""
    if not math.isclose(seconds, system.dt, rel_tol=ROUNDING):
        raise SpecificationError(
            f"env.dt is {system.dt:g} s, but a step of {model} takes {seconds:g} s: set env.dt "
            f"to that."
        )


def check_amplitude(system: BlackBox, low: Array, high: Array, inputs: str) -> None:
    """Raise SpecificationError if γ is beyond the bounds, (m,) each, of inputs with some name."""
    bound = float(np.min([-low, high]))
    if bound <= 0:
        raise SpecificationError(
            f"the {inputs} go from {low} to {high}, but ranges with 0 inside are expected, as "
            f"inputs of all directions are applied: shift what the inputs mean."
        )
    if system.gamma > bound * (1 + ROUNDING):
        raise SpecificationError(
            f"env.gamma is {system.gamma:g}, but the {inputs} go to {bound:g} only: set env.gamma "
            f"to that or less."
        )


@functools.cache
def unknown_accelerations(n: int) -> Equation:
    """Return the equation of n accelerations that are known from measurements alone: NaN."""
    nothing = (math.nan,) * n

    def accelerations(state: Scalar, parameters: Scalar) -> Sequence[Scalar]:  # noqa: ARG001
        return nothing

    accelerations.__module__ = "measured"  # not of the package, whose code is stored
    return accelerations


def transitions(
    system: BlackBox, inputs: Array, seed: int
) -> tuple[Array, Array, Array, npt.NDArray[np.bool_]]:
    """Run an episode under inputs (T, m).

    Returned are states (T, d), applied inputs (T, m), accelerations (T, r) and which there are: not
    the steps before which or after which the run had ended or restarted.
    """
    episode = system.episode(seed)
    states = np.empty((len(inputs) + 1, system.n_states))
    applied = np.empty_like(inputs)
    states[0] = episode.state
    joined = np.ones(len(inputs), dtype=np.bool_)
    for t, u in enumerate(inputs):
        applied[t] = episode.step(u)
        if (start := new_start(episode)) is not None:
            states[t], joined[max(t - 1, 0)] = start, t == 0
        states[t + 1] = episode.state
    seen = system.observed(states, applied)
    inside = np.all(np.abs(states) <= system.state_limit, axis=1)
    return system.sampled_states(states), applied, seen, joined & inside[:-1] & inside[1:]


TRIED = 16
"""States at which it is tried of which state another one is the rate."""

_SEED = 20_261_123


def differentiated(system: System) -> tuple[list[int], list[float]]:
    """Return for each state the measured one whose difference estimates it, and its factor.

    The state is itself with the factor 1 if it is measured, and -1 if it is neither measured nor
    proportional to the rate of a measured state, all of which is known. The factor is that rate in
    units of the state that it estimates.
    """
    rng = np.random.default_rng(_SEED)
    states = rng.uniform(-1.0, 1.0, (system.n_states, TRIED))
    inputs = rng.uniform(-1.0, 1.0, (system.n_inputs, TRIED))
    with np.errstate(all="ignore"):
        rates = system.known_flow(states.T, inputs.T).T
    kinematic = [i for i in system.measured_states if i not in system.learned_rows]
    sources, found = list[int](), list[float]()
    for index, state in enumerate(states):
        factors = {i: float(rates[i][0] / state[0]) for i in kinematic}
        of = [i for i, c in factors.items() if c and np.allclose(rates[i], c * state, ROUNDING, 0)]
        of = sorted(of, key=lambda i: factors[i] != 1.0)
        measured = index in system.measured_states
        sources.append(index if measured else of[0] if of else -1)
        found.append(factors[of[0]] if of and not measured else 1.0)
    return sources, found


def start_variances(system: System) -> Array:
    """Return the variances of a state from which an exploration of a plant begins or goes on, (d,).

    The measured states are known up to their noise, and the others, which are taken for 0, up to
    the half-widths of the box, or 1. Inputs in flight are known.
    """
    deviations = np.ones(system.n_states)
    deviations[system.n_states - system.n_carried :] = 0.0
    deviations[list(system.grid_indices)] = system.grid_half_widths
    deviations[list(system.measured_states)] = system.measurement_noise
    return deviations**2


def delay(system: System) -> float:
    """Return by how many steps differences come after what they are the rates of."""
    own = differentiated(system)[0][: system.n_states - system.n_carried]
    if all(state == of for state, of in enumerate(own)):
        return 0.0
    simulated = system.integrator == "euler" and not isinstance(system, BlackBox)
    return 1.0 if simulated else 0.5
