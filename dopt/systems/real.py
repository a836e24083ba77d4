"""Simulated systems behind real hardware: late, slow and cut inputs, counts and dry friction.

Inputs in flight and actuators are known states behind the system's own, so that policies,
models and learners see an ordinary system. With w_k the input of k steps ago, w_0 = u, a delay of
n + f samples and an actuator of time constant τ,

    dv/dt = (w - v)/τ,  w = w_{n+1} in the first share f of a step and w_n in the rest of it.

In the system acts the mean of v over the step, or of w without a lag. The Euler map moves the
inputs in flight by one place and v as far as the integral does, both exactly:
dw_k/dt = (w_{k-1} - w_k)/dt.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from dopt.errors import IncompatibleError, SpecificationError
from dopt.fields import Validated, parameter
from dopt.registry import build, section_of
from dopt.systems.base import Array, System
from dopt.systems.black_box import BlackBox, Episode, new_start
from dopt.systems.elementary import tanh
from dopt.types import Equation

LONGEST_DELAY = 100.0
"""Samples: each is a state for every input."""

DRY_RATE = 2.0
"""Rate at which dry friction has 76 % of its value, by its acceleration and dt.

With it the friction takes at most half of a small rate in a step: Euler steps do not overshoot.
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hardware(Validated):
    """Hardware between a policy and a system (:func:`Real`).

    Parameters
    ----------
    delay : float
        Samples from an input to its effect, fractions included.
    lag : float
        Time constant τ of each actuator [s].
    counts : float or None
        Counts a turn of the encoders by which angles are measured.
    coulomb : float
        Dry friction, an acceleration against the rate of each learned row, in its unit.
    supply : float or None
        Largest magnitude of each input, in its unit; what is beyond is cut.
    """

    section = "plant"
    name = "real"

    delay: float = parameter(0.0, "samples", "nonnegative")
    lag: float = parameter(0.0, "s", "nonnegative")
    counts: float | None = parameter(None, bound="positive")
    coulomb: float = parameter(0.0, bound="nonnegative")
    supply: float | None = parameter(None, bound="positive")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.delay > LONGEST_DELAY:
            raise SpecificationError(
                f"plant.delay is {self.delay:g} samples, but at most {LONGEST_DELAY:g} are "
                f"expected: set plant.delay to fewer, or env.dt to a longer step."
            )

    @property
    def settings(self) -> dict[str, float]:
        """Settings that differ from a system without hardware, by name."""
        fields = dataclasses.fields(self)
        own = {field.name: getattr(self, field.name) for field in fields}
        return {field.name: own[field.name] for field in fields if own[field.name] != field.default}

    @property
    def whole(self) -> int:
        """Steps n after which an input begins to act."""
        return math.floor(self.delay)

    @property
    def in_flight(self) -> int:
        """Number of inputs in flight, n or n + 1."""
        return math.ceil(self.delay)


def Real(  # noqa: N802  # it is used as a class
    system: System,
    *,
    delay: float = 0.0,
    lag: float = 0.0,
    counts: float | None = None,
    coulomb: float = 0.0,
    supply: float | None = None,
) -> System:
    """Return a system behind real hardware, or the system itself if nothing is set.

    Its class is derived from the class of the system.

    Parameters
    ----------
    system : System
        Simulated system. With a delay or a lag its integrator is 'euler', and the effect of its
        inputs is known.
    delay, lag, counts, coulomb, supply
        As of :class:`Hardware`. The delay is in samples, of :class:`dopt.Plant` in seconds.
        Encoders round angles that are in ``measured_states``, all angles if that is empty;
        learners are told the noise of the rounding.

    Raises
    ------
    SpecificationError
        If a value is outside its bound.
    IncompatibleError
        If the system has not what a setting needs.
    """
    hardware = Hardware(delay=delay, lag=lag, counts=counts, coulomb=coulomb, supply=supply)
    return behind(system, hardware)


def real_from_mapping(system: System, section: Mapping[str, object]) -> System:
    """Return a system behind what a section ``plant`` describes; itself for the name "ideal"."""
    registry: dict[str, type[Validated]] = {"ideal": Ideal, "real": Hardware}
    hardware = build("plant", registry, section)
    return behind(system, hardware) if isinstance(hardware, Hardware) else system


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ideal(Validated):
    """No hardware: inputs act at once."""

    section = "plant"
    name = "ideal"


def behind(system: System, hardware: Hardware) -> System:
    """Return a system behind hardware."""
    if not hardware.settings:
        return system
    _check(system, hardware)
    carried = hardware.in_flight + (hardware.lag > 0)
    shapes = (system.n_states, system.n_inputs, len(system.physical), system.learned_rows)
    flags = (hardware.in_flight > hardware.whole, hardware.lag > 0, hardware.coulomb > 0)
    own: Any = type(system)
    kind: Any = _class(own, shapes, hardware.whole, flags)
    values = {field.name: getattr(system, field.name) for field in dataclasses.fields(system)}
    extra = (0.0,) * (carried * system.n_inputs)
    if values["initial_state"]:
        values["initial_state"] += extra
    rows = np.array(system.output_matrix).reshape(-1, system.n_states)
    values["output_matrix"] = tuple(np.pad(rows, ((0, 0), (0, len(extra)))).ravel().tolist())
    if hardware.counts is not None:
        noises = dict(zip(system.measured_states, system.measurement_noise, strict=True))
        values["measured_states"] = measured = system.measured_states or system.angle_indices
        noise = 2.0 * math.pi / hardware.counts / math.sqrt(12.0)
        values["measurement_noise"] = tuple(
            noise if index in system.angle_indices else noises[index] for index in measured
        )
    made: System = kind(**values, wrapped=system, hardware=hardware)
    return made


def _check(system: System, hardware: Hardware) -> None:
    """Refuse hardware that does not go with a system."""
    late = hardware.delay > 0 or hardware.lag > 0
    measured = system.measured_states or system.angle_indices
    for refused, what, expected in (
        (system.wrapped is not None, "plant", "a system without hardware"),
        (isinstance(system, BlackBox) and system.measured, "plant", "a simulated system"),
        (late and system.integrator != "euler", "plant.delay or lag", "env.integrator 'euler'"),
        (late and system.reads_inputs, "plant.delay or lag", "known effects of the inputs"),
        (
            hardware.counts is not None
            and not (set(measured) & set(system.angle_indices) and not system.output_matrix),
            "plant.counts",
            "angles that are measured one by one",
        ),
        (
            hardware.coulomb > 0 and isinstance(system, BlackBox),
            "plant.coulomb",
            "a system with equations",
        ),
    ):
        if refused:
            raise IncompatibleError(
                f"{what} of env '{system.name}' is set, but {expected} is expected for it: leave "
                f"it out, or choose another env."
            )


def following_actuator(
    v: Any, newer: Any, older: Any, fraction: float, lag: float, dt: float
) -> tuple[Any, Any]:
    """Return the mean of an actuator's output over dt seconds, and the output at their end.

    Parameters
    ----------
    v
        Output at the start; without a lag it does not matter.
    newer, older
        Input that reaches the actuator in the last, and in the first share ``fraction`` of dt.
    """
    mean = 0.0
    for share, w in ((fraction, older), (1.0 - fraction, newer)):
        if share == 0.0:
            continue
        if lag == 0.0:
            mean, v = mean + share * w, w
            continue
        constants = share * dt / lag
        passed = -math.expm1(-constants)
        mean = mean + share * (w + (v - w) * (passed / constants))
        v = v + (w - v) * passed
    return mean, v


class _Behind:
    """Base of the classes of systems behind hardware, beside the class of the system."""

    def __post_init__(self: Any) -> None:
        system, hardware = self.wrapped, self.hardware
        names = [label.partition(" [") for label in system.input_labels]
        ages = [f" {k} ago" for k in range(1, hardware.in_flight + 1)]
        ages += [" acting"] if hardware.lag else []
        labels = [f"{name}{age}{gap}{unit}" for age in ages for name, gap, unit in names]
        dry = ("coulomb",) if hardware.coulomb and system.linear_parameters else ()
        shape = {
            "state_labels": (*system.state_labels, *labels),
            "input_labels": system.input_labels,
            "learned_rows": system.learned_rows,
            "features": system.features,
            "angle_indices": system.angle_indices,
            "grid_indices": system.grid_indices,
            "physical": (*system.physical, *_NUMBERS),
            "linear_parameters": (*system.linear_parameters, *dry),
            "equilibrium": system.equilibrium and (*system.equilibrium, *[0.0] * len(labels)),
            "n_carried": len(labels),
            "lead_steps": hardware.whole,
            "cut_at": math.inf if hardware.supply is None else hardware.supply,
        }
        for attribute, value in shape.items():
            object.__setattr__(self, attribute, value)
        System.__post_init__(self)

    @property
    def parameters(self: Any) -> tuple[float, ...]:
        """Physical parameters of the system, and the numbers of its hardware."""
        hardware, dt = self.hardware, self.dt
        fraction = hardware.delay - hardware.whole
        v, newer, older = np.eye(3)
        mean, end = following_actuator(v, newer, older, fraction, hardware.lag, dt)
        rate = DRY_RATE * hardware.coulomb * dt
        return (*self.wrapped.parameters, *mean.tolist(), *end.tolist(), dt, hardware.coulomb, rate)

    @property
    def output_quanta(self: Any) -> tuple[float, ...]:
        counts, angles = self.hardware.counts, self.angle_indices
        quantum = 2.0 * math.pi / counts if counts else 0.0
        if not self.measured_states:
            return (0.0,) * int(self.n_measured)
        return tuple(quantum if index in angles else 0.0 for index in self.measured_states)

    def __reduce__(self: Any) -> tuple[Any, ...]:
        """Pickle the system and its hardware: the class is made again."""
        return behind, (self.wrapped, self.hardware)

    def to_section(self: Any) -> dict[str, object]:
        """Return the section of the system, with its hardware in it."""
        hardware = {"name": self.hardware.name, **self.hardware.settings}
        return {**section_of(self.wrapped), "plant": hardware}

    def try_out(self: Any) -> None:
        self.wrapped.try_out()

    def episode(self: Any, seed: int) -> Episode:
        return _Episode(self, self.hardware, self.wrapped.episode(seed))

    def true_accelerations(self: Any, states: Array, inputs: Array) -> Array | None:
        own: BlackBox = self.wrapped
        return own.true_accelerations(states[:, : own.n_states], inputs)


_NUMBERS = (
    *("mean_actuator", "mean_newer", "mean_older", "end_actuator", "end_newer", "end_older"),
    *("sample", "coulomb", "coulomb_rate"),
)
"""Numbers of the hardware behind the physical parameters of a system."""


class Flight:
    """Inputs on their way to a plant, and its actuators.

    Parameters
    ----------
    delay : float
        Samples from an input to its effect.
    lag : float
        Time constant of the actuators [s].
    dt : float
        Time of a sample [s].
    n_inputs : int
        m.

    Attributes
    ----------
    inputs : list of (m,)
        Those in flight, the newest first.
    actuator : (m,)
        Output of the actuators.
    """

    def __init__(self, delay: float, lag: float, dt: float, n_inputs: int) -> None:
        self._whole, self._fraction = math.floor(delay), delay % 1.0
        self.lag, self._dt = lag, dt
        self.inputs = [np.zeros(n_inputs)] * math.ceil(delay)
        self.actuator = np.zeros(n_inputs)

    def depart(self, u: Array) -> Array:
        """Send an input, and return what acts in the step that begins with it, (m,)."""
        waiting = [u, *self.inputs]
        newer, older = waiting[self._whole], waiting[math.ceil(self._whole + self._fraction)]
        mean, self.actuator = following_actuator(
            self.actuator, newer, older, self._fraction, self.lag, self._dt
        )
        self.inputs = waiting[: len(self.inputs)]
        acting: Array = np.asarray(mean)
        return acting

    def settle(self, u: Array) -> None:
        """Take all inputs in flight, and what the actuators put out, for one input."""
        self.inputs, self.actuator = [u] * len(self.inputs), u

    def ahead(self) -> tuple[Array, Array]:
        """Return what acts until an input that departs now arrives, (n, m), and for how long [s].

        It changes nothing.
        """
        shares = [1.0] * self._whole
        shares = [self._fraction, *shares] if self._fraction else shares
        acting, v = np.empty((len(shares), len(self.actuator))), self.actuator
        for i, (share, u) in enumerate(zip(shares, reversed(self.inputs), strict=True)):
            acting[i], v = following_actuator(v, u, u, 0.0, self.lag, share * self._dt)
        return acting, self._dt * np.array(shares)


class _Episode:
    """A run of a black box behind hardware; see :class:`dopt.systems.black_box.Episode`."""

    def __init__(self, system: System, hardware: Hardware, inner: Episode) -> None:
        self._flight = Flight(hardware.delay, hardware.lag, system.dt, system.n_inputs)
        self._inner, self._cut_at, self._lagging = inner, system.cut_at, hardware.lag > 0
        self.new_start: Array | None = None

    @property
    def state(self) -> Array:
        return self._with_inputs(self._inner.state)

    def _with_inputs(self, state: Array) -> Array:
        actuator = [self._flight.actuator] if self._lagging else []
        return np.concatenate([state, *self._flight.inputs, *actuator])

    def step(self, inputs: Array) -> Array:
        """Send an input, cut to the supply; apply what arrives, and return the former."""
        applied: Array = np.clip(inputs, -self._cut_at, self._cut_at)
        self.new_start, waiting = None, self._with_inputs(np.empty(0))
        self._inner.step(self._flight.depart(applied))
        if (start := new_start(self._inner)) is not None:
            self.new_start = np.concatenate([start, waiting])
        return applied


@functools.cache
def _class(
    kind: type[System],
    shapes: tuple[int, int, int, tuple[int, ...]],
    whole: int,
    flags: tuple[bool, bool, bool],
) -> type[System]:
    """Return the class of systems of a kind, of a shape (d, m, parameters, learned rows).

    Their delay has a whole number of samples and, by the flags, a fraction; there is a lag, and dry
    friction.
    """
    d, m, n, rows = shapes
    fractional, lagging, dry = flags
    shape = "_".join(map(str, (whole, *map(int, flags), d, m, n)))
    lines = _known_text(d, m, n, whole, fractional, lagging)
    namespace: dict[str, Any] = {
        "__module__": kind.__module__,
        "known": staticmethod(_around(kind.known, f"known_of_{kind.__name__}_{shape}", lines)),
    }
    if not issubclass(kind, BlackBox):
        lines = _accelerations_text(
            n, rows, f":{d}" if whole or fractional or lagging else ":", dry
        )
        made = _around(kind.accelerations, f"accelerations_of_{kind.__name__}_{shape}", lines)
        namespace["accelerations"] = staticmethod(made)
    fields = [
        (name, Any, dataclasses.field(metadata={"validated": False}))
        for name in ("wrapped", "hardware")
    ]
    return dataclasses.make_dataclass(
        kind.__name__, fields, bases=(_Behind, kind), namespace=namespace, frozen=True, kw_only=True
    )


def _known_text(d: int, m: int, n: int, whole: int, fractional: bool, lagging: bool) -> list[str]:
    """Return the lines of the known part for d states, m inputs and n parameters of a system."""
    in_flight = whole + fractional
    carried = range(d, d + (in_flight + lagging) * m, m)
    waiting = [[f"state[{first + j}]" for j in range(m)] for first in carried]
    waiting.insert(0, [f"inputs[{j}]" for j in range(m)])
    actuator = waiting[-1]

    def mixed(first: int, j: int) -> str:
        if not (fractional or lagging):
            return waiting[whole][j]
        parts = {first + 1: waiting[whole][j]}
        parts |= {first: actuator[j]} if lagging else {}
        parts |= {first + 2: waiting[whole + 1][j]} if fractional else {}
        return " + ".join(f"parameters[{i}] * {text}" for i, text in parts.items())

    acting = [mixed(n, j) for j in range(m)]
    moved = [
        f"({waiting[k][j]} - {waiting[k + 1][j]}) / parameters[{n + 6}]"
        for k in range(in_flight)
        for j in range(m)
    ]
    if lagging:
        moved += [f"({mixed(n + 3, j)} - {actuator[j]}) / parameters[{n + 6}]" for j in range(m)]
    rates = [*(f"flow[{i}]" for i in range(d)), *moved]
    return [
        "(state, inputs, parameters):",
        f"flow = around(state[:{d}], ({', '.join(acting)},), parameters[:{n}])",
        f"return ({', '.join(rates)},)",
    ]


def _accelerations_text(n: int, rows: tuple[int, ...], own: str, dry: bool) -> list[str]:
    """Return the lines of the accelerations of learned rows, with dry friction or without."""
    values = [f"free[{k}]" for k in range(len(rows))]
    if dry:
        coulomb, rate = f"parameters[{n + 7}]", f"parameters[{n + 8}]"
        frictions = [f"{coulomb} * tanh(state[{row}] / {rate})" for row in rows]
        values = [f"{one} - {other}" for one, other in zip(values, frictions, strict=True)]
    return [
        "(state, parameters):",
        f"free = around(state[{own}], parameters[:{n}])",
        f"return ({', '.join(values)},)",
    ]


def _around(equation: Equation, name: str, lines: list[str]) -> Equation:
    """Return a function of some lines that calls an equation, as of the equation's own module."""
    namespace: dict[str, Any] = {"around": equation, "tanh": tanh, "__name__": equation.__module__}
    exec(f"def {name}" + "\n    ".join(lines), namespace)  # of numbers alone
    made: Equation = namespace[name]
    return made
