"""Base class of physical systems.

All systems are control-affine with known kinematics and a known input term,

    dx/dt = known(x, u) + E a(x),

where a(x), r accelerations at u = 0, is what the exploration learns and E puts them into the r
``learned_rows`` of the state derivative (design note to equation 1 of the paper). Where the effect
of the inputs is learned as well (``reads_inputs``), it is a(x, u).

=========  ==========================================  ============
symbol     meaning                                     shape
=========  ==========================================  ============
x          state                                       d
u          input                                       m
p          physical parameters, in declared order      number of them
a          learned accelerations                       r
=========  ==========================================  ============
"""

from __future__ import annotations

import dataclasses
import functools
import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt

from dopt.algorithm import RUNGE_KUTTA_SHARES, RUNGE_KUTTA_WEIGHTS, Integrator
from dopt.errors import SpecificationError
from dopt.fields import Validated, parameter
from dopt.systems.elementary import cos, sin
from dopt.types import Scalar


def check_number(n: int) -> None:
    """Refuse a number of points of a low-discrepancy set.

    Raises
    ------
    SpecificationError
        If n is not a power of two: other numbers of points are spread less evenly.
    """
    if n & (n - 1):
        raise SpecificationError(
            f"env.grid_points is [{n}], but a power of two is expected for a low-discrepancy set: "
            f"set it to {2 ** (n.bit_length() - 1)} or {2 ** n.bit_length()}."
        )


def sobol_midpoints(dimensions: int, n: int) -> npt.NDArray[np.float64]:
    """Return the first n points of a Sobol sequence in the unit cube, (n, dimensions).

    They are moved by half of 1/n, so that along every axis they are the n midpoints of a regular
    partition, each once. Reference: I. Sobol, "On the distribution of points in a cube and the
    approximate evaluation of integrals" (1967), with the direction numbers of S. Joe and F. Kuo,
    "Constructing Sobol sequences with better two-dimensional projections" (2008).

    Raises
    ------
    SpecificationError
        If :func:`check_number` refuses n.
    """
    from scipy.stats import qmc  # its import takes longer than a short trial

    check_number(n)
    points: npt.NDArray[np.float64] = qmc.Sobol(dimensions, scramble=False).random(n)
    return points + 0.5 / n


INTEGRATORS = tuple(integrator.name.lower() for integrator in Integrator)


def next_state(integrator: str, rate: Callable[[Scalar], Scalar], x: Scalar, dt: float) -> Scalar:
    """Return the state dt seconds after x, for arrays and tensors alike.

    ``rate`` is dx/dt. With "rk4" it is the classical method of Runge and Kutta of fourth order.
    """
    slope = rate(x)
    if integrator == Integrator.EULER.name.lower():
        return x + dt * slope
    total = RUNGE_KUTTA_WEIGHTS[0] * slope
    for share, weight in zip(RUNGE_KUTTA_SHARES, RUNGE_KUTTA_WEIGHTS[1:], strict=True):
        slope = rate(x + share * dt * slope)
        total = total + weight * slope
    return x + dt * total


Kind = Literal["identity", "cos", "sin"]
KINDS: tuple[Kind, ...] = ("identity", "cos", "sin")


@dataclass(frozen=True)
class Feature:
    """One network input: ``kind`` of the state component ``index``.

    An ``identity`` feature is divided by the half-width of the evaluation grid along that
    component, so that every input of the network is of order one.
    """

    kind: Kind
    index: int


def identity(*indices: int) -> tuple[Feature, ...]:
    """Return components of the state as features."""
    return tuple(Feature("identity", index) for index in indices)


def turn(index: int) -> tuple[Feature, Feature]:
    """Return cosine and sine of an angle as features."""
    return Feature("cos", index), Feature("sin", index)


def feature_values(
    features: tuple[Feature, ...], scales: tuple[float, ...], state: Scalar
) -> list[Scalar]:
    """Return the features of a state, given as a sequence of d scalars, arrays or tensors."""
    maps = {"identity": lambda x: x, "cos": cos, "sin": sin}
    return [
        maps[feature.kind](state[feature.index]) / scale
        for feature, scale in zip(features, scales, strict=True)
    ]


Array = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, kw_only=True)
class System(Validated):
    """A physical system with its exploration setting; subclasses add the physical parameters.

    The two equations are static methods over sequences of scalars, arrays or tensors, so that one
    definition serves the simulator, the evaluation, automatic differentiation and the compiled
    kernel. ``compiled`` says whether the kernel runs it, and ``reads_inputs`` whether the learned
    accelerations depend on the inputs.

    Where ``measured_states`` names states by their indices, policy and learner are given
    y = C x + v in the place of x, these states with noise of the standard deviations
    ``measurement_noise``, in their units. The states are then estimated: by a learner that does so
    (:class:`dopt.learning.JointKalman`), or else by a low-pass filter of ``velocity_cutoff`` [Hz]
    and differences (:mod:`dopt.systems.black_box`). Outputs that mix states are given by
    ``output_matrix``, the numbers of C row by row; then a learner has to estimate the states.

    Behind real hardware (:func:`dopt.systems.Real`) the last ``n_carried`` states are inputs in
    flight and actuators, an input begins to act ``lead_steps`` steps after it was chosen, its
    magnitude is cut to ``cut_at``, and ``wrapped`` is the system itself.
    """

    section: ClassVar[str] = "env"
    name: ClassVar[str]
    compiled: ClassVar[bool] = True
    reads_inputs: ClassVar[bool] = False
    physical: ClassVar[tuple[str, ...]]
    linear_parameters: ClassVar[tuple[str, ...]] = ()
    state_labels: ClassVar[tuple[str, ...]]
    input_labels: ClassVar[tuple[str, ...]]
    learned_rows: ClassVar[tuple[int, ...]]
    features: ClassVar[tuple[Feature, ...]]
    angle_indices: ClassVar[tuple[int, ...]] = ()
    phase_plane: ClassVar[tuple[int, int]]
    grid_indices: ClassVar[tuple[int, ...]]
    low_discrepancy: ClassVar[bool] = False
    equilibrium: ClassVar[tuple[float, ...] | None] = None
    n_carried: ClassVar[int] = 0
    lead_steps: ClassVar[int] = 0
    cut_at: ClassVar[float] = math.inf
    wrapped: ClassVar[System | None] = None

    gamma: float = parameter(1.0, bound="positive")
    dt: float = parameter(0.02, "s", "positive")
    noise: float = parameter(1e-3, bound="nonnegative")
    horizon: int = parameter(500, "steps", "positive")
    initial_state: tuple[float, ...] = ()
    grid_half_widths: tuple[float, ...] = parameter((), bound="positive")
    grid_points: tuple[int, ...] = parameter((), bound="positive")
    state_limit: float = parameter(1e4, bound="positive")
    integrator: str = parameter("euler", choices=INTEGRATORS, added=True)
    measured_states: tuple[int, ...] = parameter((), bound="nonnegative", added=True)
    measurement_noise: tuple[float, ...] = parameter((), bound="positive", added=True)
    output_matrix: tuple[float, ...] = parameter((), added=True)
    velocity_cutoff: float = parameter(2.0, "Hz", "positive", added=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        axes = len(self.grid_indices)
        self._check_size("initial_state", self.n_states)
        self._check_size("grid_half_widths", axes)
        self._check_size("grid_points", 1 if self.low_discrepancy else axes)
        self._check_measured()
        if self.low_discrepancy:
            check_number(self.grid_points[0])

    def _check_size(self, field: str, size: int) -> None:
        given = getattr(self, field)
        if len(given) != size:
            raise SpecificationError(
                f"env.{field} has {len(given)} entries, but {self.name} needs {size}: "
                f"give one for each of them."
            )

    def _check_measured(self) -> None:
        """Refuse measurements of states that there are not, and another number of noises."""
        given = self.measured_states
        if len(set(given)) < len(given) or any(index >= self.n_states for index in given):
            raise SpecificationError(
                f"env.measured_states is {list(given)}, but indices from 0 to {self.n_states - 1} "
                f"are expected, none twice: the states of {self.name} are "
                f"{', '.join(self.state_labels)}."
            )
        self._check_output_matrix()
        self._check_size("measurement_noise", self.n_measured)

    def _check_output_matrix(self) -> None:
        """Refuse a C without whole rows, with one of zeros, and one beside measured states."""
        given, d = self.output_matrix, self.n_states
        if given and self.measured_states:
            raise SpecificationError(
                f"env.output_matrix is {list(given)} and env.measured_states is "
                f"{list(self.measured_states)}, but one of the two is expected: a row of the "
                f"matrix with a single 1 measures a state."
            )
        if len(given) % d:
            raise SpecificationError(
                f"env.output_matrix has {len(given)} entries, but {self.name} needs {d} for each "
                f"output, one for each state: {', '.join(self.state_labels)}."
            )
        if not self.output_rows.any(axis=1).all():
            raise SpecificationError(
                f"env.output_matrix is {list(given)}, but no row of {d} zeros is expected: it "
                f"measures nothing, so leave it out."
            )

    @staticmethod
    @abstractmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> Sequence[Scalar]:
        """Return the known part of dx/dt: d scalars."""

    @staticmethod
    @abstractmethod
    def accelerations(state: Scalar, parameters: Scalar) -> Sequence[Scalar]:
        """Return the learned accelerations: r scalars.

        ``state`` holds the d scalars of x, followed by the scalars of u if the system reads inputs.
        """

    @property
    def n_states(self) -> int:
        """State dimension d."""
        return len(self.state_labels)

    @property
    def n_inputs(self) -> int:
        """Input dimension m."""
        return len(self.input_labels)

    @property
    def n_measured(self) -> int:
        """Number n of outputs, measured with noise; 0 where all states are known without."""
        return len(self.measured_states) + len(self.output_matrix) // self.n_states

    @property
    def output_rows(self) -> Array:
        """Matrix C of the outputs y = C x + v, (n, d)."""
        if self.output_matrix:
            return np.array(self.output_matrix).reshape(-1, self.n_states)
        return np.eye(self.n_states)[list(self.measured_states)]

    @property
    def output_quanta(self) -> tuple[float, ...]:
        """Step to which each output is rounded in place of noise, (n,); 0 where it has noise."""
        return (0.0,) * self.n_measured

    @property
    def n_learned(self) -> int:
        """Number of learned accelerations r."""
        return len(self.learned_rows)

    @property
    def parameters(self) -> tuple[float, ...]:
        """Physical parameters in the order of ``physical``."""
        return tuple(getattr(self, name) for name in self.physical)

    @functools.cached_property
    def history(self) -> Array:
        """Physical parameters of each step, (T, number of them); one row for one that stays.

        They enter the learned accelerations. The known part, which a policy and a model are given,
        takes :attr:`parameters` at all times.
        """
        return np.array([self.parameters])

    @property
    def state_limits(self) -> Array:
        """Largest magnitude of each state, (d,), of which some may be angles."""
        return np.full(self.n_states, self.state_limit)

    @property
    def feature_scales(self) -> tuple[float, ...]:
        """Divisor of each feature: the grid's half-width for an identity, 1 otherwise."""
        widths = dict(zip(self.grid_indices, self.grid_half_widths, strict=True))
        return tuple(
            widths.get(feature.index, 1.0) if feature.kind == "identity" else 1.0
            for feature in self.features
        )

    def grid_box(self) -> dict[int, tuple[float, float]]:
        """Return the evaluation box: state index -> (low, high)."""
        return {
            index: (-half, half)
            for index, half in zip(self.grid_indices, self.grid_half_widths, strict=True)
        }

    def grid(self) -> Array:
        """Return the evaluation states, (N, d): midpoints of a regular partition of the box.

        The mean over them is the midpoint rule for the mean over the box. Components that the
        learned accelerations do not depend on are zero. A system with too many axes for that
        (``low_discrepancy``) is judged on the first N points of a Sobol sequence.
        """
        states = np.zeros((math.prod(self.grid_points), self.n_states))
        if self.low_discrepancy:
            low, high = np.array(list(self.grid_box().values())).T
            unit = sobol_midpoints(len(self.grid_indices), len(states))
            states[:, list(self.grid_indices)] = low + (high - low) * unit
            return states
        axes = [
            (low + (high - low) * (np.arange(n) + 0.5) / n)
            for (low, high), n in zip(self.grid_box().values(), self.grid_points, strict=True)
        ]
        mesh = np.meshgrid(*axes, indexing="ij")
        states[:, list(self.grid_indices)] = np.stack([axis.ravel() for axis in mesh], axis=1)
        return states

    def featurize(self, states: Array) -> Array:
        """Return the network's inputs, (N, n_features), of states, (N, d)."""
        values = feature_values(self.features, self.feature_scales, np.moveaxis(states, -1, 0))
        return np.stack(values, axis=-1)

    def learned(
        self, states: Array, steps: npt.ArrayLike = 0, inputs: Array | None = None
    ) -> Array:
        """Return the true accelerations, (N, r), of states, (N, d), at a step or at (N,) steps.

        The inputs, (N, m), count where the system reads them; without any they are 0. A system that
        has changed stays as it is at the horizon.
        """
        points = self.points(states, inputs)
        values = self.accelerations(tuple(points.T), self._parameters_at(steps))
        return np.stack(np.broadcast_arrays(*values), axis=-1)

    def points(self, states: Array, inputs: Array | None = None) -> Array:
        """Return what the learned accelerations depend on: the states, (N, d), or (N, d + m)."""
        return with_inputs(states, inputs, self.n_inputs if self.reads_inputs else 0)

    def _parameters_at(self, steps: npt.ArrayLike) -> Sequence[Scalar]:
        """Return the physical parameters at a step, or arrays of them at (N,) steps."""
        if len(self.history) == 1:
            return self.parameters
        return tuple(self.history[np.minimum(steps, len(self.history) - 1)].T)

    def derivative(self, state: npt.ArrayLike, inputs: npt.ArrayLike, step: int = 0) -> Array:
        """Return dx/dt = f(x, u), equation 1, of one state (d,) and input (m,) at a step."""
        x, u = tuple(np.asarray(state)), tuple(np.asarray(inputs))
        flow = np.array(self.known(x, u, self.parameters))
        point = (*x, *u) if self.reads_inputs else x
        rows = np.array(self.accelerations(point, self._parameters_at(step)))
        kind = np.result_type(flow, rows)
        flow = flow.astype(kind)
        flow[list(self.learned_rows)] += rows
        return flow

    def known_flow(self, states: Array, inputs: Array) -> Array:
        """Return the known part of dx/dt, (N, d), at states (N, d) under inputs (N, m)."""
        known = self.known(tuple(states.T), tuple(inputs.T), self.parameters)
        return np.stack(np.broadcast_arrays(*known, states[:, 0])[:-1], axis=-1)

    def observed(self, states: Array, inputs: Array) -> Array:
        """Return the accelerations, (T, r), seen between states (T + 1, d) under (T, m)."""
        return self.less_known(np.diff(states, axis=0), self.sampled_states(states), inputs)

    def less_known(self, changes: Array, at: Array, inputs: Array) -> Array:
        """Return the learned part, (N, r), of changes in a step, (N, d), at (N, d) and (N, m)."""
        learned: Array = changes / self.dt - self.known_flow(at, inputs)
        return learned[:, list(self.learned_rows)]

    def sampled_states(self, states: Array) -> Array:
        """Return the states, (T, d), at which the accelerations between (T + 1, d) are observed.

        A difference of two states is the acceleration in the middle of the step up to O(dt²), and
        that at its start up to O(dt): of the Euler map it is exactly the latter.
        """
        if self.integrator == "euler":
            return states[:-1]
        return 0.5 * (states[:-1] + states[1:])

    @functools.cached_property
    def linear_form(self) -> tuple[tuple[float, ...], ...]:
        """Physical parameters at which :meth:`accelerations` yields the offset and the regressors.

        The accelerations are affine in the parameters named in ``linear_parameters``,
        a(x) = offset(x) + Psi(x) theta: the first entry sets all of these to 0, entry 1 + j sets
        the j-th of them to 1.
        """
        values = dict(zip(self.physical, self.parameters, strict=True))
        zero = values | dict.fromkeys(self.linear_parameters, 0.0)
        points = [zero] + [zero | {name: 1.0} for name in self.linear_parameters]
        return tuple(tuple(point[name] for name in self.physical) for point in points)


def with_inputs(states: Array, inputs: Array | None, n_inputs: int) -> Array:
    """Return states, (N, d), with inputs, (N, m), beside them if ``n_inputs`` are read; else 0."""
    if not n_inputs:
        return states
    if inputs is None:
        inputs = np.zeros((len(states), n_inputs))
    return np.concatenate([states, inputs], axis=-1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Repeated(System):
    """A system of n equal parts, from whose number its attributes follow.

    ``counted`` names the field n, and ``most`` is the largest n. A field of ``repeated`` that has
    the numbers of one part, so many, has them for each. The attributes of the class belong to the
    default n.
    """

    counted: ClassVar[str]
    most: ClassVar[int]
    repeated: ClassVar[dict[str, int]]

    @staticmethod
    @abstractmethod
    def shape(n: int) -> dict[str, tuple[object, ...]]:
        """Return what follows from the number of parts, by attribute."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        default = getattr(cls, cls.counted)
        for attribute, value in cls.shape(getattr(default, "default", default)).items():
            setattr(cls, attribute, value)

    def __post_init__(self) -> None:
        Validated.__post_init__(self)
        n = getattr(self, self.counted)
        if n > self.most:
            raise SpecificationError(
                f"env.{self.counted} is {n}, but it has to be at most {self.most}: set "
                f"env.{self.counted} to a smaller number."
            )
        for attribute, value in self.shape(n).items():
            object.__setattr__(self, attribute, value)
        for field, size in self.repeated.items():
            given = getattr(self, field)
            if given == given[:size] * (len(given) // size):
                object.__setattr__(self, field, given[:size] * n)
        super().__post_init__()
