"""Limits of a trial: bounds of states and inputs, and rates at which inputs may change.

The input that a policy chooses is moved into the box of inputs and towards the input before it, as
far as the rates demand. Then the states that would follow are predicted with the model, over some
steps in which a backup input is held: ±γ along an axis, or 0. If none of them keeps the states
within their bounds, also with accelerations that are wrong by ``margin`` standard deviations, the
input is replaced (:mod:`dopt.kernel.limits`). Where states are estimated, the estimate from which
the prediction starts is taken to be wrong as well (:class:`dopt.learning.JointKalman`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from dopt.arguments import instance, within
from dopt.errors import SpecificationError, unknown_name
from dopt.fields import Validated, parameter, unvalidated
from dopt.systems.base import System
from dopt.types import Array

VIOLATIONS, WORST = "violations", "worst"
"""Measures: number of states beyond a bound, and the farthest distance beyond one."""

Interval = tuple[float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Limits(Validated):
    """Bounds that a trial has to heed.

    >>> Limits(bounds=(("y", -2.0, 2.0),), rates=(("u", 100.0),))

    In a section of a configuration ``bounds`` maps names to pairs, with null where there is no
    bound, and ``rates`` names to numbers.

    Parameters
    ----------
    bounds : tuple of (name, lower, upper)
        Bounds of states and inputs by name, in their units; infinite without a bound. An
        input's bounds include 0.
    rates : tuple of (name, rate)
        Largest change of inputs, in their unit per second.
    steps : int
        Number of predicted steps.
    margin : float
        Error of the predicted accelerations that is reckoned with, in standard deviations: of the
        model's own uncertainty, scaled by the errors it has made; and of estimated states.
    enforced : bool
        Whether inputs are replaced. Otherwise states beyond the bounds are counted alone.
    """

    section: ClassVar[str] = "limits"
    name: ClassVar[str] = "box"

    steps: int = parameter(50, "steps", "positive")
    margin: float = parameter(3.0, bound="nonnegative")
    bounds: tuple[tuple[str, float, float], ...] = unvalidated(())
    rates: tuple[tuple[str, float], ...] = unvalidated(())
    enforced: bool = unvalidated(True)

    def __post_init__(self) -> None:
        super().__post_init__()
        bounds = ((name, *_interval(name, pair)) for name, pair in _named("bounds", self.bounds))
        rates = (
            (name, within(f"limits.rates.{name}", rate, math.inf))
            for name, rate in _named("rates", self.rates)
        )
        object.__setattr__(self, "bounds", tuple(bounds))
        object.__setattr__(self, "rates", tuple(rates))
        instance("limits.enforced", self.enforced, bool, "true or false")

    def to_section(self) -> dict[str, object]:
        """Return the section that describes these limits in a configuration."""
        return {
            "name": self.name,
            "bounds": {
                name: [end if math.isfinite(end) else None for end in pair]
                for name, *pair in self.bounds
            },
            "rates": dict(self.rates),
            "steps": self.steps,
            "margin": self.margin,
            "enforced": self.enforced,
        }

    def check(self, system: System) -> None:
        """Raise if nothing is bounded, a name is unknown, or the bounds of an input exclude 0."""
        states, inputs = names_of(system.state_labels), names_of(system.input_labels)
        ends = [end for _, *pair in self.bounds for end in pair]
        if not self.rates and not any(map(math.isfinite, ends)):
            raise SpecificationError(
                "limits have neither a bound nor a rate, but at least one is expected: set "
                f"limits.bounds of {', '.join((*states, *inputs))}, or choose limits=none."
            )
        for name, low, high in self.bounds:
            if name not in (*states, *inputs):
                raise unknown_name("state or input in limits.bounds", name, (*states, *inputs))
            if name in inputs and not low <= 0.0 <= high:
                raise _unlike(f"bounds.{name}", [low, high], "an interval with 0 in it")
        for name, _ in self.rates:
            if name not in inputs:
                raise unknown_name("input in limits.rates", name, inputs)

    def of_states(self, system: System) -> Array:
        """Return the lower and the upper bound of each state, (d, 2)."""
        return self._of(names_of(system.state_labels))

    def of_inputs(self, system: System) -> Array:
        """Return the lower and the upper bound of each input, (m, 2)."""
        return self._of(names_of(system.input_labels))

    def _of(self, names: Sequence[str]) -> Array:
        given = {name: (low, high) for name, low, high in self.bounds}
        return np.array([given.get(name, (-math.inf, math.inf)) for name in names])

    def changes(self, system: System) -> Array:
        """Return the largest change of each input from one step to the next, (m,)."""
        rates, names = dict(self.rates), names_of(system.input_labels)
        return np.array([rates.get(name, math.inf) * system.dt for name in names])

    def excess(self, system: System, states: Array) -> Array:
        """Return how far each state, (N, d), is beyond its bounds, (N,), in units of the states.

        It is 0 within the bounds, and of several states the largest.
        """
        low, high = self.of_states(system).T
        beyond: Array = np.maximum(low - states, states - high).max(axis=1, initial=0.0)
        return beyond


LIMITS: dict[str, type[Limits]] = {Limits.name: Limits}


def names_of(labels: Sequence[str]) -> list[str]:
    """Return the names in labels such as ``"y [m]"``."""
    return [label.partition(" [")[0] for label in labels]


def _named(key: str, given: object) -> list[tuple[str, Any]]:
    """Return what a mapping, or tuples that begin with a name, give for each name."""
    if isinstance(given, Mapping | None):
        return [(str(name), value) for name, value in (given or {}).items()]
    entries: list[Any] = [None]
    if isinstance(given, Sequence) and not isinstance(given, str):
        entries = [*given]
    if not all(isinstance(one, Sequence) and len(one) > 1 for one in entries):
        raise _unlike(key, given, "a mapping of names")
    return [(str(name), rest if len(rest) > 1 else rest[0]) for name, *rest in entries]


def _interval(name: str, given: object) -> Interval:
    pair: list[Any] = []
    if isinstance(given, Sequence | np.ndarray) and not isinstance(given, str):
        pair = [*given]
    ends = (-math.inf, math.inf)
    found = [e if one is None else _number(one) for one, e in zip(pair, ends, strict=False)]
    if len(pair) != 2 or not found[0] < found[1]:  # also where one is NaN
        expected = "a pair of numbers, the lower one first, or null for none"
        raise _unlike(f"bounds.{name}", pair or given, expected)
    return found[0], found[1]


def _number(given: object) -> float:
    """Return a float; NaN for anything that is not a number or is too large."""
    if not isinstance(given, int | float | np.number) or isinstance(given, bool):
        return math.nan
    try:
        return float(given)
    except (OverflowError, TypeError):
        return math.nan


def _unlike(what: str, given: object, expected: str) -> SpecificationError:
    return SpecificationError(
        f"limits.{what} is {given!r}, but {expected} is expected: correct it."
    )
