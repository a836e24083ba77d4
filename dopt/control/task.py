"""Control tasks: goal, cost, tolerances and planner settings of an episode."""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar, Protocol

from dopt.errors import IncompatibleError, SpecificationError
from dopt.fields import Validated, parameter
from dopt.systems.base import System
from dopt.types import Array

# State feedback: an input for each state.


class Feedback(Protocol):
    """A law of control that is evaluated every ``hold`` steps; its input is held in between."""

    @property
    def hold(self) -> int: ...

    def __call__(self, state: Array) -> Array:
        """Return the input, (m,), ‖u‖ ≤ γ, at a state, (d,)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Control(Validated):
    """A control task, how it is planned, and after which steps of a trial.

    The cost of an episode is the sum over its steps of

        Σ_i w_i e_i² + w_u ‖u‖²,

    where e_i is the error of state component i against the goal, and e_i² is 2 - 2 cos e_i for an
    angle: the same near the goal, and without a jump at the turn. An episode succeeds if in each
    of its last ``settle_steps`` states every error is within its tolerance.

    A field that is None takes the value of the system's own task (:data:`GOALS`): swinging up the
    pendulum and the cartpole, a set-point of the arm and of the quadrotor.

    Parameters
    ----------
    checkpoints : tuple of int
        Numbers of explored steps after which the model is assessed, besides 0 and the horizon.
    initial_state, goal : tuple of float
        States (d,) in which an episode starts and should end, in the units of the state.
    state_weights : tuple of float
        w_i of every state component, 1 / unit².
    input_weight : float
        w_u, 1 / unit of the input².
    tolerances : tuple of float
        Largest error of every state component, in its unit; 0 asks nothing of it.
    steps : int
        Length of an episode.
    settle_steps : int
        Number of last states that have to be at the goal.
    hold : int
        Steps for which a planned input is held.
    lookahead : int
        Number of planned inputs; the planner sees ``hold * lookahead`` steps.
    samples, iterations, elites : int
        Of the cross-entropy method (:mod:`dopt.control.planning`).
    free_run_steps : int
        Steps n over which the model's prediction runs free (:mod:`dopt.control.planning`).
    """

    section: ClassVar[str] = "task"
    name: ClassVar[str] = "control"

    checkpoints: tuple[int, ...] = parameter((100, 200), "steps", "positive")
    initial_state: tuple[float, ...] | None = parameter(None)
    goal: tuple[float, ...] | None = parameter(None)
    state_weights: tuple[float, ...] | None = parameter(None, bound="nonnegative")
    input_weight: float | None = parameter(None, bound="nonnegative")
    tolerances: tuple[float, ...] | None = parameter(None, bound="nonnegative")
    steps: int | None = parameter(None, "steps", "positive")
    settle_steps: int | None = parameter(None, "steps", "positive")
    hold: int | None = parameter(None, "steps", "positive")
    lookahead: int | None = parameter(None, bound="positive")
    samples: int = parameter(64, bound="positive")
    iterations: int = parameter(3, bound="positive")
    elites: int = parameter(8, bound="positive")
    free_run_steps: int = parameter(25, "steps", "positive")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.elites > self.samples:
            raise SpecificationError(
                f"task.elites is {self.elites}, but it has to be at most task.samples, which is "
                f"{self.samples}: lower it."
            )
        object.__setattr__(self, "checkpoints", tuple(sorted(set(self.checkpoints))))

    def on(self, system: System) -> Goal:
        """Return the task with every field set; the system's own values take the place of None.

        Raises
        ------
        IncompatibleError
            If the system has no task of its own and a field is None.
        SpecificationError
            If a value does not fit the system.
        """
        if len(system.history) > 1:
            raise IncompatibleError(
                f"env '{system.name}' changes with time, but a control task judges a model by one "
                f"truth: leave the task out with task=none."
            )
        chosen = {name: getattr(self, name) for name in GOAL_FIELDS}
        missing = [name for name, value in chosen.items() if value is None]
        own = GOALS.get(system.name)
        if own is None and missing:
            raise IncompatibleError(
                f"env '{system.name}' has no control task of its own, and "
                f"{', '.join(f'task.{name}' for name in missing)} are not given: set them, or "
                f"leave the task out with task=none."
            )
        given = {name: value for name, value in chosen.items() if value is not None}
        goal = Goal(**chosen) if own is None else dataclasses.replace(own, **given)
        self._check(goal, system)
        return goal

    def _check(self, goal: Goal, system: System) -> None:
        for name in ("initial_state", "goal", "state_weights", "tolerances"):
            entries = len(getattr(goal, name))
            if entries != system.n_states:
                raise SpecificationError(
                    f"task.{name} has {entries} entries, but {system.name} needs "
                    f"{system.n_states}: give one for each state component."
                )
        if goal.settle_steps > goal.steps:
            raise SpecificationError(
                f"task.settle_steps is {goal.settle_steps}, but it has to be at most task.steps, "
                f"which is {goal.steps}: lower it."
            )

    def resolved(self, system: System) -> Control:
        """Return the task of a trial: the system's own values where a field was None.

        Raises
        ------
        SpecificationError
            As :meth:`on` does, and if a checkpoint lies beyond the end of a trial.
        """
        if self.checkpoints and self.checkpoints[-1] > system.horizon:
            raise SpecificationError(
                f"task.checkpoints holds step {self.checkpoints[-1]}, but a trial has "
                f"{system.horizon} steps: lower it, or raise env.horizon."
            )
        return dataclasses.replace(self, **vars(self.on(system)))

    def assessed_steps(self, horizon: int) -> tuple[int, ...]:
        """Return the numbers of explored steps to assess, ascending: 0 and the horizon too."""
        return tuple(sorted({0, *self.checkpoints, horizon}))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Goal:
    """Settings of a task that depend on the system; fields as in :class:`Control`.

    The tasks of the shipped systems share the values that are given here.
    """

    initial_state: tuple[float, ...]
    goal: tuple[float, ...]
    state_weights: tuple[float, ...]
    input_weight: float = 1e-3
    tolerances: tuple[float, ...]
    steps: int
    settle_steps: int = 50
    hold: int
    lookahead: int = 15


GOAL_FIELDS = tuple(field.name for field in dataclasses.fields(Goal))
"""Fields of a task that differ from system to system."""


GOALS = {
    # From hanging to upright in 8 s and upright for the last second; γ is 40 % of the torque that
    # holds the rod level, so the planner has to see most of a swing of 1.6 s to pump.
    "pendulum": Goal(
        initial_state=(1e-3, 0.0),
        goal=(math.pi, 0.0),
        state_weights=(1.0, 0.02),
        tolerances=(0.5, 2.0),
        steps=400,
        hold=5,
    ),
    # From hanging to upright in 8 s, within 1 m of the middle of the track for the last second.
    "cartpole": Goal(
        initial_state=(0.0, 0.0, math.pi, 0.0),
        goal=(0.0, 0.0, 0.0, 0.0),
        state_weights=(0.1, 0.05, 1.0, 0.02),
        tolerances=(1.0, 2.0, 0.5, 2.0),
        steps=400,
        hold=5,
    ),
    # From hanging to a bent posture in 4 s, kept for the last one; to hold it takes 4.7 N m of 5.
    "arm": Goal(
        initial_state=(0.0, 0.0, 0.0, 0.0),
        goal=(0.2, 0.0, 0.25, 0.0),
        state_weights=(10.0, 0.2, 10.0, 0.2),
        tolerances=(0.05, 0.5, 0.05, 0.5),
        steps=200,
        hold=2,
    ),
    # From rest to a point 7 m away, diagonally up, in 20 s, hovering there for the last 5 s.
    "quadrotor": Goal(
        initial_state=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        goal=(5.0, 0.0, 5.0, 0.0, 0.0, 0.0),
        state_weights=(1.0, 0.2, 1.0, 0.2, 1.0, 0.5),
        tolerances=(0.5, 1.5, 0.5, 1.5, 0.5, 0.5),
        steps=200,
        hold=2,
    ),
    # From rest to displacements in 4 s, kept for the last one; to hold them takes 4.0 N of 5.
    "mass_spring": Goal(
        initial_state=(0.0, 0.0, 0.0, 0.0),
        goal=(0.25, 0.0, 0.1, 0.0),
        state_weights=(10.0, 0.2, 10.0, 0.2),
        tolerances=(0.05, 0.5, 0.05, 0.5),
        steps=200,
        hold=2,
    ),
}
"""The tasks of the shipped systems with their usual parameters."""
