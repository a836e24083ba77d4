"""A plant that is measured and not simulated, declared by names, units and its known part."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NoReturn

import numpy as np

from dopt.errors import SpecificationError, unknown_name
from dopt.fields import unvalidated
from dopt.systems.base import Feature
from dopt.systems.black_box import BlackBox, unknown_accelerations
from dopt.systems.expressions import check_names, compiled_text
from dopt.systems.properties import input_effect, rounded, scales, sizes
from dopt.systems.real import LONGEST_DELAY, Flight
from dopt.types import Array

NAME = "plant"
"""Name of every plant in configurations and in the results database."""


@dataclasses.dataclass(frozen=True)
class Unknown:
    """A number that a fit estimates, with what is known of it before (:func:`unknown`).

    Attributes
    ----------
    value : float
        First guess.
    factor : float
        The logarithm of the number by the guess has this factor's for a standard deviation, so that
        the number keeps its sign; 0 where ``spread`` is given.
    spread : float
        Standard deviation of the number about the guess, in its unit.
    """

    value: float
    factor: float = 0.0
    spread: float = 0.0

    def __post_init__(self) -> None:
        for what, number in dataclasses.asdict(self).items():
            if not _is_number(number):
                raise SpecificationError(
                    f"{what} of an unknown is {number!r}, but a finite number is expected: "
                    f"correct it."
                )
        if (self.factor > 0) == (self.spread > 0) or min(self.factor, self.spread) < 0:
            raise SpecificationError(
                f"an unknown has the factor {self.factor:g} and the spread {self.spread:g}, but "
                f"one of the two above 0 is expected: give a factor, or a spread in its unit."
            )
        if self.factor > 0 and (self.factor <= 1 or self.value == 0):
            raise SpecificationError(
                f"an unknown has the value {self.value:g} and the factor {self.factor:g}, but a "
                f"value other than 0 and a factor above 1 are expected: give a spread in its unit, "
                f"if it may be 0 or of either sign."
            )

    def at(self, z: float) -> float:
        """Return the number z standard deviations above the guess."""
        if self.factor:
            return self.value * math.exp(min(math.log(self.factor) * z, 300.0))  # steps overshoot
        return self.value + self.spread * z

    def slope(self, z: float) -> float:
        """Return the derivative of :meth:`at`."""
        return math.log(self.factor) * self.at(z) if self.factor else self.spread


def unknown(value: float, factor: float | None = None, *, spread: float | None = None) -> Unknown:
    """Return a number that a fit estimates: a first guess, and how far off it may be.

    Parameters
    ----------
    value : float
        First guess, in the unit of the number.
    factor : float, optional
        Factor by which the guess may be wrong, one standard deviation of the logarithm; 2 unless a
        spread is given.
    spread : float, optional
        Standard deviation of a number that may be 0 or change its sign, in its unit.

    Raises
    ------
    SpecificationError
        If both are given, a number is not finite, or the guess of a factor is 0.
    """
    if factor is None and spread is None:
        factor = 2.0
    return Unknown(value, factor or 0.0, spread or 0.0)


@dataclasses.dataclass(frozen=True)
class Encoder:
    """An angle that is measured in steps of a turn (:func:`encoder`)."""

    counts: float

    @property
    def quantum(self) -> float:
        """Step of the measured angle [rad]."""
        return 2.0 * math.pi / self.counts

    @property
    def noise(self) -> float:
        """Standard deviation of the rounding, quantum/√12 [rad]."""
        return self.quantum / math.sqrt(12.0)


def encoder(counts: float) -> Encoder:
    """Return an encoder of so many counts a turn, four for each line in quadrature."""
    if not _is_number(counts) or counts <= 0:
        raise SpecificationError(
            f"counts of an encoder is {counts!r}, but a positive number a turn is expected: "
            f"correct it."
        )
    return Encoder(float(counts))


def first_guess(given: float | Unknown) -> float:
    """Return a number that is known, or the first guess of one that is not."""
    return float(given.value if isinstance(given, Unknown) else given)


def _noise(given: float | Encoder) -> float:
    return given.noise if isinstance(given, Encoder) else float(given)


def _section_of(given: Any) -> Any:
    """Return a number, or a mapping for an unknown or an encoder."""
    if isinstance(given, Unknown | Encoder):
        parts = dataclasses.asdict(given).items()
        return {name: float(part) for name, part in parts if part or name == "value"}
    return float(given)


def _from_section(given: Any) -> Any:
    if isinstance(given, Mapping):
        return Encoder(**given) if "counts" in given else unknown(**given)
    return given


_MAPPINGS = ("states", "inputs", "known", "box", "constants", "measured")

_LISTS = ("learned", "angles")

_TIMES = ("delay", "lag")

_ORDERED = ("states", "inputs")
"""Mappings whose order counts, which sections hold as lists of pairs."""

LIMIT = 1e4
"""Limit of a plant that declares none, where it is explored in its own units."""

LARGEST_SIZE = 1000.0
"""Limit of a state, in units of its size, of a plant that declares none."""

GRID_POINTS = 8
"""Points to an axis of the evaluation box."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plant:
    """Declaration of a plant for :class:`dopt.Explorer`.

    Its derivative is known(x, u) + E a(x): what is known of it, and the accelerations of the rows
    ``learned``, which the exploration learns. Inputs whose effect is not known are left out of the
    known part; then the model has to read them, such as 'affine'.

    >>> motor = Plant(
    ...     states={"angle": "rad", "rate": "rad/s"},
    ...     inputs={"voltage": "V"},
    ...     dt=0.005,
    ...     gamma=6.0,
    ...     known={"angle": "rate", "rate": "gain * voltage"},
    ...     constants={"gain": 40.0},
    ...     learned=["rate"],
    ...     angles=["angle"],
    ...     box={"rate": 20.0},
    ... )

    Parameters
    ----------
    states, inputs : mapping of str to str
        Names of the d states and the m inputs, each with its unit.
    dt : float
        Time between two measurements [s].
    gamma : float
        Largest norm of an input.
    known : mapping of str to str
        Known part of the derivative of each state, as an expression in the names of states, inputs
        and constants (:mod:`dopt.systems.expressions`); 0 for a state that is left out. It is
        affine in the inputs.
    learned : sequence of str
        States whose derivatives have a part that is learned.
    box : mapping of str to float
        Half-width of the region of interest along each state that a(x) depends on. An angle that
        is left out has π.
    angles : sequence of str
        States in radians of which a(x) is a function of period 2π. They may be measured over one
        turn or over many: each is followed from one state to the next.
    constants : mapping of str to float or Unknown
        Numbers that the expressions name. :func:`dopt.fit` and the learner 'simulation_error'
        estimate what is :func:`dopt.unknown`; explorations by other learners take its first guess.
    measured : mapping of str to float or Encoder
        Standard deviation of the noise of each state that is measured, or :func:`dopt.encoder`;
        without any, all states are measured, and their noise is left to the learner.
    velocity_cutoff : float
        Cutoff of the filter of these states and their differences [Hz], with a learner that does
        not estimate states.
    limit : float, optional
        Largest magnitude of a state that can be a measurement, except for angles; what is beyond is
        left out. Without one it is 1,000 times the size of each state, its half-width of the box.
    integrator : {"euler", "rk4"}
        How the model's accelerations are compared with two states: as that at the first one, or
        integrated over the step by the method of Runge and Kutta.
    delay : float or Unknown
        Time from an input to its effect [s], fractions of a step included. An exploration plans
        for the state in which its input will arrive, and learns from what acts.
    lag : float or Unknown
        Time constant of the actuator, which follows an input as a filter of first order [s].
    supply : float
        Largest magnitude of each input that the actuator can apply; what is beyond is cut.

    Raises
    ------
    SpecificationError
        If a name, a number or an expression is not as described.
    """

    states: Mapping[str, str]
    inputs: Mapping[str, str]
    dt: float
    gamma: float
    known: Mapping[str, str]
    learned: Sequence[str]
    box: Mapping[str, float]
    angles: Sequence[str] = ()
    constants: Mapping[str, float | Unknown] = dataclasses.field(default_factory=dict)
    limit: float | None = None
    integrator: str = "euler"
    measured: Mapping[str, float | Encoder] = dataclasses.field(default_factory=dict)
    velocity_cutoff: float = 2.0
    delay: float | Unknown = 0.0
    lag: float | Unknown = 0.0
    supply: float = math.inf

    def __post_init__(self) -> None:
        self._check_types()
        for what in _MAPPINGS:  # copies: what a caller changes later changes no plant
            object.__setattr__(self, what, dict(getattr(self, what)))
        for what in _LISTS:
            object.__setattr__(self, what, tuple(getattr(self, what)))
        check_names("a plant", [*self.states, *self.inputs, *self.constants])
        for what in ("known", "learned", "box", "angles", "measured"):
            for name in getattr(self, what):
                if name not in self.states:
                    raise unknown_name(f"state in '{what}' of a plant", name, self.states)
        self._check_numbers()
        _check_effect(self.system(1))

    def _check_types(self) -> None:
        for what in _MAPPINGS:
            if not isinstance(getattr(self, what), Mapping):
                raise _unlike(what, getattr(self, what), "a mapping of names")
        for what in _LISTS:
            given = getattr(self, what)
            if isinstance(given, str) or not isinstance(given, Sequence):
                raise _unlike(what, given, "a list of states")
            if not all(isinstance(name, str) for name in given):
                raise _unlike(what, given, "a list of names of states")
            if len(set(given)) < len(given):
                raise _unlike(what, given, "a list that names no state twice")
        for what in ("states", "inputs", "learned"):
            if not getattr(self, what):
                raise SpecificationError(
                    f"a plant has no {what}, but at least one is expected: name it."
                )
        if not (self.box or self.angles):
            raise SpecificationError(
                "a plant has neither a box nor angles, but what is learned has to depend on some "
                "states: give the half-width of the box for each of them."
            )

    def _check_numbers(self) -> None:
        positive = {"dt": self.dt, "gamma": self.gamma, "velocity_cutoff": self.velocity_cutoff}
        positive |= {} if self.limit is None else {"limit": self.limit}
        measured = {k: v for k, v in self.measured.items() if not isinstance(v, Encoder)}
        for what, named in (("box", self.box), ("measured", measured)):
            positive |= {f"{what}['{name}']": number for name, number in named.items()}
        for what, number in positive.items():
            if not _is_number(number) or number <= 0:
                raise _unlike(what, number, "a positive number")
        for name, value in self.constants.items():
            if not (_is_number(value) or isinstance(value, Unknown)):
                raise _unlike(f"constants['{name}']", value, "a finite number or dopt.unknown()")
        for name, noise in self.measured.items():
            if isinstance(noise, Encoder) and name not in self.angles:
                raise _unlike(
                    f"measured['{name}']", noise, "an encoder of a state named in angles="
                )
        for what in _TIMES:
            given = getattr(self, what)
            first = given.value if isinstance(given, Unknown) else given
            if not _is_number(first) or first < 0:
                raise _unlike(what, given, "a number of seconds, at least 0, or dopt.unknown()")
            if what == "delay" and first > LONGEST_DELAY * self.dt:
                raise _unlike(what, given, f"at most {LONGEST_DELAY:g} times dt")
        if not (_is_number(self.supply) or self.supply == math.inf) or self.supply <= 0:
            raise _unlike("supply", self.supply, "a positive number")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the declaration, and not the class that was made of it."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return functools.partial(Plant, **fields), ()

    def to_section(self) -> dict[str, object]:
        """Return the section of a configuration that :meth:`from_section` turns into the plant."""
        ordered = {key: [list(pair) for pair in getattr(self, key).items()] for key in _ORDERED}
        lists = {key: list(getattr(self, key)) for key in _LISTS}
        numbers = {key: float(getattr(self, key)) for key in ("dt", "gamma")}
        numbers |= {} if self.limit is None else {"limit": float(self.limit)}
        named = {
            key: {name: _section_of(value) for name, value in getattr(self, key).items()}
            for key in ("box", "constants")
        }
        section = {"name": NAME, **ordered, "known": self.known, **named, **lists, **numbers}
        if self.integrator != "euler":  # explorations were stored before there was another one
            section["integrator"] = self.integrator
        if self.measured:
            section["measured"] = {
                name: _section_of(value) for name, value in self.measured.items()
            }
            section["velocity_cutoff"] = float(self.velocity_cutoff)
        section |= {
            what: _section_of(getattr(self, what)) for what in _TIMES if getattr(self, what)
        }
        if self.supply < math.inf:
            section["supply"] = float(self.supply)
        return section

    @classmethod
    def from_section(cls, section: Mapping[str, Any]) -> ExploredPlant:
        """Return the system that a section describes, which also says how many steps it has."""
        own = ("name", "horizon", "scaled")
        given = {key: value for key, value in section.items() if key not in own}
        fields = [field.name for field in dataclasses.fields(cls)]
        for key in given:
            if key not in fields:
                raise unknown_name("field of a plant", key, fields)
        ordered: dict[str, Any] = {key: dict(given[key]) for key in _ORDERED}
        for key in ("constants", "measured"):
            named = given.get(key, {})
            ordered[key] = {name: _from_section(value) for name, value in named.items()}
        ordered |= {key: _from_section(given[key]) for key in _TIMES if key in given}
        scaled = bool(section.get("scaled", False))
        return cls(**(given | ordered)).system(section["horizon"], scaled=scaled)

    @classmethod
    def from_mapping(cls, given: Mapping[str, Any]) -> Plant:
        """Return the plant that a mapping of its arguments describes, such as a YAML file.

        An unknown number is ``{value}``, ``{value, factor}`` or ``{value, spread}``, as of
        :func:`unknown`, an encoder ``{counts}``.

        Raises
        ------
        SpecificationError
            If an argument is missing, has another name, or is not as described.
        """
        fields = dataclasses.fields(cls)
        for field in fields:
            needed = field.default is field.default_factory is dataclasses.MISSING
            if needed and field.name not in given:
                raise SpecificationError(
                    f"a plant has no {field.name}, but it is expected: give it, as in the "
                    f"documentation of dopt.Plant."
                )
        for what in ("states", "inputs", "constants", "measured"):
            if not isinstance(given.get(what, {}), Mapping):
                raise _unlike(what, given[what], "a mapping of names")
        try:
            return cls.from_section({**given, "horizon": 1}).plant
        except TypeError as error:
            raise SpecificationError(
                f"the arguments of a plant do not fit ({error}): give unknown numbers as "
                f"{{value, factor}} or {{value, spread}}, and encoders as {{counts}}."
            ) from error

    def system(self, horizon: int, *, scaled: bool = False) -> ExploredPlant:
        """Return the plant as the system of an exploration of so many steps, in its own units.

        ``scaled`` says whether the exploration works with numbers that do not depend on them
        (:meth:`ExploredPlant.in_scales`).
        """
        system = self._system(self._class, (1.0,) * len(self.states), 1.0, horizon)
        return dataclasses.replace(system, scaled=scaled)

    def _system(
        self, kind: type[ExploredPlant], scales: Sequence[float], scale: float, horizon: int
    ) -> ExploredPlant:
        """Return the system whose states are divided by numbers, (d,), and whose inputs by one."""
        half_widths = dict.fromkeys(self.angles, math.pi) | dict(self.box)
        units = dict(zip(self.states, scales, strict=True))
        axes = [name for name in self.states if name in half_widths]
        measured = [name for name in self.states if name in self.measured]

        def divided(numbers: Mapping[str, float]) -> tuple[float, ...]:
            if kind is self._class:
                return tuple(numbers.values())
            divisors = [units[name] for name in numbers]
            return tuple(rounded(np.array([*numbers.values()]) / divisors).tolist())

        return kind(
            gamma=self.gamma / scale,
            dt=self.dt,
            horizon=horizon,
            state_limit=LIMIT if self.limit is None else self.limit,
            integrator=self.integrator,
            measured_states=tuple([*self.states].index(name) for name in measured),
            measurement_noise=divided({name: _noise(self.measured[name]) for name in measured}),
            velocity_cutoff=self.velocity_cutoff,
            grid_half_widths=divided({name: half_widths[name] for name in axes}),
            grid_points=(GRID_POINTS,) * len(axes),
        )

    @property
    def guesses(self) -> dict[str, float]:
        """The constants, each unknown one by its first guess."""
        return {name: first_guess(value) for name, value in self.constants.items()}

    @functools.cached_property
    def _class(self) -> type[ExploredPlant]:
        """A class of systems with what this plant declares."""
        return self._class_in({}, ())

    @functools.cached_property
    def scales(self) -> tuple[float, ...]:
        """Divisors of the states in scaled numbers (:mod:`dopt.systems.properties`)."""
        return scales(self.system(1), self._sizes)

    @functools.cached_property
    def _sizes(self) -> Array:
        return sizes(self.system(1))

    @functools.cached_property
    def _scaled_class(self) -> type[ExploredPlant]:
        """The class of the same systems in scaled numbers."""
        units = dict(zip(self.states, self.scales, strict=True))
        return self._class_in(units | dict.fromkeys(self.inputs, float(self.gamma)), self.scales)

    def _class_in(
        self, units: Mapping[str, float], results: Sequence[float]
    ) -> type[ExploredPlant]:
        names = list(self.states)
        groups = {"states": names, "inputs": [*self.inputs], "constants": [*self.constants]}
        known = {f"known['{name}'] of a plant": self.known.get(name, "0.0") for name in names}
        axes = [i for i, name in enumerate(names) if name in self.angles or name in self.box]
        features = [one for i in axes for one in _features(i, names[i] in self.angles)]
        declared: dict[str, Any] = {
            "plant": self,
            "_constants": tuple(self.guesses.values()),
            "physical": tuple(self.constants),
            "state_labels": tuple(f"{name} [{unit}]" for name, unit in self.states.items()),
            "input_labels": tuple(f"{name} [{unit}]" for name, unit in self.inputs.items()),
            "learned_rows": tuple(names.index(name) for name in self.learned),
            "angle_indices": tuple(names.index(name) for name in self.angles),
            "features": tuple(features),
            "grid_indices": tuple(axes),
            "phase_plane": _phase_plane(axes, names),
            "cut_at": float(self.supply) / (float(self.gamma) if units else 1.0),
            "known": staticmethod(compiled_text(known, groups, self.guesses, units, results)),
            "accelerations": staticmethod(unknown_accelerations(len(self.learned))),
        }
        return dataclasses.dataclass(frozen=True, kw_only=True)(
            type(ExploredPlant.__name__, (ExploredPlant,), declared)
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExploredPlant(BlackBox):
    """A plant as the system of an exploration; :class:`Plant` makes a class of its own for each.

    Its accelerations are NaN: they are known from measurements alone. It is in the units of its
    plant; ``scaled`` says whether its exploration works with :meth:`in_scales`, as all do that
    began since there are scales.
    """

    name: ClassVar[str] = NAME
    compiled: ClassVar[bool] = True
    measured: ClassVar[bool] = True
    plant: ClassVar[Plant]
    _constants: ClassVar[tuple[float, ...]] = ()

    scaled: bool = unvalidated(False)
    fitted: tuple[float, ...] = unvalidated(())  # constants, delay and lag in place of the guesses

    @property
    def state_limits(self) -> Array:
        if not self.scaled or self.plant.limit is not None:
            return super().state_limits
        return LARGEST_SIZE * self.plant._sizes

    def in_scales(self) -> ExploredPlant:
        """Return the system in numbers that do not depend on the units of the plant.

        Its states are divided by :attr:`Plant.scales`, and its inputs by gamma.
        """
        plant = self.plant
        system = plant._system(plant._scaled_class, plant.scales, plant.gamma, self.horizon)
        return dataclasses.replace(system, state_limit=LIMIT, fitted=self.fitted)

    @property
    def parameters(self) -> tuple[float, ...]:
        return self.fitted[:-2] or self._constants

    def flight(self) -> Flight | None:
        """Return the inputs on their way to the plant, none yet after zeros; None if none are."""
        plant = self.plant
        if not (plant.delay or plant.lag):
            return None
        delay, lag = self.fitted[-2:] or (first_guess(plant.delay), first_guess(plant.lag))
        samples = round(delay / self.dt, 9)  # of 0.3 s by 0.1 s, 3
        return Flight(samples, lag, self.dt, self.n_inputs)

    def to_section(self) -> dict[str, object]:
        """Return what identifies the plant and its exploration."""
        section = {**self.plant.to_section(), "horizon": self.horizon}
        if self.scaled:
            return section | {"scaled": True}
        return section | {"limit": float(self.state_limit)}

    def episode(self, seed: int) -> NoReturn:  # noqa: ARG002
        raise SpecificationError(
            "a plant is measured and not simulated, so that no trial of it can be run: drive it "
            "with dopt.Explorer."
        )


def _features(index: int, is_angle: bool) -> list[Feature]:
    if is_angle:
        return [Feature("cos", index), Feature("sin", index)]
    return [Feature("identity", index)]


def _phase_plane(axes: Sequence[int], names: Sequence[str]) -> tuple[int, int]:
    """Return the two states of a phase portrait: the first two that the accelerations depend on."""
    chosen = [*axes, *(i for i in range(len(names)) if i not in axes), 0]
    return chosen[0], chosen[1]


def _check_effect(system: ExploredPlant) -> None:
    """Refuse a known part that fails, or is not affine in the inputs."""
    try:
        effect = input_effect(system)
    except (ArithmeticError, ValueError) as error:
        raise SpecificationError(
            f"the known part of a plant fails ({error}), but numbers are expected of it over the "
            f"box: correct its expressions."
        ) from error
    if not effect.is_affine:
        raise SpecificationError(
            "the known part of a plant is not affine in its inputs, but a derivative of the form "
            "f(x) + B(x) u is expected: make the inputs other quantities, in which it is."
        )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and math.isfinite(value)


def _unlike(what: str, given: object, expected: str) -> SpecificationError:
    return SpecificationError(
        f"'{what}' of a plant is {given!r}, but {expected} is expected: correct it."
    )
