"""A compiled policy of one's own: the input that leads farthest from the newest states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.kernel.plugin import Trial, input_columns, predicted_state
from dopt.policies.base import Array, CompiledPolicy, CustomPolicy, Planner
from dopt.systems import System
from dopt.trial_view import TrialView


@dataclass(frozen=True, kw_only=True)
class Frontier(CompiledPolicy, CustomPolicy):
    """Of ±γ along each input axis, take the one whose next state is farthest from its neighbours.

    Parameters
    ----------
    newest : int
        How many of the newest states count.
    """

    name: ClassVar[str] = "frontier"

    newest: int = parameter(50, "states", "positive")

    @staticmethod
    def plan(trial: Trial, t: int, u: Array) -> None:
        """Write the input u_t for the compiled kernel."""
        plant, states = trial.plant, trial.record.states
        newest = int(trial.algorithm.policy[0])
        seen = states[max(0, t + 1 - newest) : t + 1]
        center = predicted_state(plant, trial.network, trial.state.theta, states[t])
        columns = input_columns(plant, states[t])
        best = -1.0
        for j in range(2 * u.shape[0]):
            size = plant.gamma if j % 2 == 0 else -plant.gamma
            nearest = squared_distance(center + size * columns[j // 2], seen)
            if nearest > best * (1.0 + 1e-9):
                best = nearest
                u[:] = 0.0
                u[j // 2] = size

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002  # nothing is random here
        """Return the same plan in numpy, for the reference path."""
        return _Planner(system, self.newest)


def squared_distance(point: Array, seen: Array) -> float:
    """Return the squared distance of a state, (d,), from the nearest of states, (n, d)."""
    nearest = np.inf
    for s in range(seen.shape[0]):
        total = 0.0
        for i in range(point.shape[0]):
            total += (point[i] - seen[s, i]) ** 2
        nearest = min(nearest, total)
    return nearest


class _Planner(Planner):
    def __init__(self, system: System, newest: int) -> None:
        axes = system.gamma * np.eye(system.n_inputs)
        self._inputs = np.stack([axes, -axes], axis=1).reshape(-1, system.n_inputs)
        self._newest = newest

    def choose(self, view: TrialView) -> Array:
        best, chosen = -1.0, self._inputs[0]
        for u, x in zip(self._inputs, view.following(view.states[-1], self._inputs), strict=True):
            nearest = squared_distance(x, view.states[-self._newest :])
            if nearest > best * (1.0 + 1e-9):
                best, chosen = nearest, u
        return chosen
