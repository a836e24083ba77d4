"""Explorations of plants in numbers that do not depend on the units of the plant.

What an explorer is told, answers and stores is in the units that the plant declares. Its steps work
with states that are divided by their sizes and inputs that are divided by γ
(:mod:`dopt.systems.properties`), so that learners, priors, differences and plans see these alone;
here one is turned into the other.

Systems with equations, and explorations that were begun before there were scales, work with the
numbers they are given.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dopt.arguments import rows_of
from dopt.control.planning import Accelerations
from dopt.errors import SpecificationError
from dopt.learning import LEARNERS, GaussNewton
from dopt.limits import Limits, names_of
from dopt.models import MODELS
from dopt.policies import POLICIES, TaskOptimal
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.systems.plant import ExploredPlant
from dopt.systems.properties import SPLIT, rounded
from dopt.types import Array


@dataclass(frozen=True, eq=False)
class Scaled:
    """A system in scaled numbers.

    Attributes
    ----------
    system : System
        The system itself, or the one whose states and inputs are scaled.
    states : (d,)
        What its states are multiplied by, in the units of the plant.
    inputs : float
        What its inputs are multiplied by.
    is_scaled : bool
        Whether the numbers are others than those in the units of the system.
    """

    system: System
    states: Array
    inputs: float
    is_scaled: bool

    def of_states(self, states: Array, rows: Sequence[int] | slice = slice(None)) -> Array:
        """Return some rows of states, (..., n), in scaled numbers."""
        if not self.is_scaled:
            return states
        found: Array = rounded(states / self.states[rows], self._splits[rows])
        return found

    @functools.cached_property
    def _splits(self) -> Array:
        splits = np.full(len(self.states), SPLIT)
        splits[list(self.system.angle_indices)] = 0.0
        return splits

    def of_inputs(self, inputs: Array) -> Array:
        """Return inputs, (..., m), in scaled numbers."""
        return rounded(inputs / self.inputs) if self.is_scaled else inputs

    def of_seconds(self, seconds: float) -> float:
        """Return a time as scaled numbers are: rounded, and in the same unit."""
        return float(rounded(seconds)) if self.is_scaled else seconds

    @functools.cached_property
    def accelerations(self) -> Array:
        """Units of the learned accelerations, (r,), by which they are multiplied."""
        return self.states[list(self.system.learned_rows)]

    def scaled_predictions(self, predict: Accelerations) -> Accelerations:
        """Return a function of scaled numbers for one in the units of the plant."""
        return lambda x, u: predict(x * self.states, u * self.inputs) / self.accelerations


@functools.lru_cache(maxsize=64)
def scaled(system: System) -> Scaled:
    """Return a system in the numbers that its exploration works with."""
    if isinstance(system, ExploredPlant) and system.scaled:
        states, gamma = np.array(system.plant.scales), float(system.gamma)
        return Scaled(system.in_scales(), states, gamma, is_scaled=True)
    return Scaled(system, np.ones(system.n_states), 1.0, is_scaled=False)


def in_scaled_numbers(spec: TrialSpec, *, damped: bool = True) -> TrialSpec:
    """Return the specification of a new exploration.

    An exploration of a plant works with scaled numbers, unless the user wrote the class of a
    policy, model or learner: it is given the numbers of the plant. ``damped`` says whether
    fits damp steps that overshoot (:class:`dopt.learning.GaussNewton`).
    """
    parts = ((spec.policy, POLICIES), (spec.model, MODELS), (spec.learner, LEARNERS))
    shipped = all(type(part) in [*registry.values()] for part, registry in parts)
    if not (shipped and isinstance(spec.system, ExploredPlant)):
        return spec
    system, learner = spec.system.plant.system(spec.system.horizon, scaled=True), spec.learner
    if damped and isinstance(learner, GaussNewton):
        learner = dataclasses.replace(learner, overshoot="damp")
    return TrialSpec(dataclasses.replace(spec.config, system=system, learner=learner), spec.seed)


def scaled_trial(spec: TrialSpec) -> TrialSpec:
    """Return the specification in scaled numbers."""
    found = scaled(spec.system)
    if not found.is_scaled:
        return spec
    policy, limits = spec.policy, spec.limits and _scaled_limits(spec.limits, found)
    if isinstance(policy, TaskOptimal) and policy.goal:
        goal = found.of_states(np.array(policy.goal))
        policy = dataclasses.replace(policy, goal=tuple(goal.tolist()))
    config = dataclasses.replace(spec.config, system=found.system, policy=policy, limits=limits)
    return TrialSpec(config, spec.seed)


def _scaled_limits(limits: Limits, found: Scaled) -> Limits:
    units = dict(zip(names_of(found.system.state_labels), found.states, strict=True))
    units |= dict.fromkeys(names_of(found.system.input_labels), found.inputs)

    def divided(name: str, number: float) -> float:
        return float(rounded(number / units[name])) if math.isfinite(number) else number

    bounds = tuple((name, divided(name, a), divided(name, b)) for name, a, b in limits.bounds)
    rates = tuple((name, divided(name, rate)) for name, rate in limits.rates)
    return dataclasses.replace(limits, bounds=bounds, rates=rates)


def learned_accelerations(
    spec: TrialSpec, parameters: Array, states: npt.ArrayLike, inputs: npt.ArrayLike | None = None
) -> Array:
    """Return the accelerations, (N, r), that a model has learned, in the units of the system.

    States, (N, d), and inputs, (N, m), or one for all, are in its units, too; ``parameters`` are of
    the model in scaled numbers.

    Raises
    ------
    SpecificationError
        If states or inputs are no numbers, or not of these shapes.
    """
    found, system = scaled(spec.system), spec.system
    x = rows_of("states", states, system.n_states)
    u: Array | None = None
    if inputs is not None:
        u = rows_of("inputs", inputs, system.n_inputs)
        if len(u) not in (1, len(x)):
            raise SpecificationError(
                f"{len(x)} states and {len(u)} inputs were given, but as many of both are "
                f"expected: give the input of each state."
            )
        u = found.of_inputs(np.broadcast_to(u, (len(x), system.n_inputs)))
    values = spec.model.predict(found.system, parameters, found.of_states(x), u)
    return values * found.accelerations
