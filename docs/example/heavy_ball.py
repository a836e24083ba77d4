"""A compiled learner of one's own: gradient descent with momentum on the newest sample."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.kernel.plugin import Trial, model_rows, sampled_point
from dopt.learning.base import Array, CompiledLearner, CustomLearner, Updater
from dopt.systems import System
from dopt.trial_view import TrialView


@dataclass(frozen=True, kw_only=True)
class HeavyBall(CompiledLearner, CustomLearner):
    """v ← μ v - η ∇‖a_θ(x) - y‖² and θ ← θ + v, for the newest sample x, y.

    Parameters
    ----------
    learning_rate : float
        η.
    momentum : float
        μ.
    """

    name: ClassVar[str] = "heavy_ball"

    learning_rate: float = parameter(1e-4, bound="positive")
    momentum: float = parameter(0.9, bound="fraction")

    @staticmethod
    def learn(trial: Trial, t: int, target: Array) -> None:
        """Update the parameters for the compiled kernel."""
        learning_rate, momentum = trial.algorithm.learner[0], trial.algorithm.learner[1]
        theta, velocity = trial.state.theta, trial.state.learner_memory
        value = np.empty(target.shape[0])
        J = model_rows(trial.plant, trial.network, theta, sampled_point(trial, t), value)
        for i in range(theta.shape[0]):
            slope = 0.0
            for k in range(target.shape[0]):
                slope += 2.0 * (value[k] - target[k]) * J[k, i]
            velocity[i] = momentum * velocity[i] - learning_rate * slope
            theta[i] += velocity[i]

    def memory_size(self, system: System, n_parameters: int) -> int:  # noqa: ARG002  # one velocity for each parameter
        """Return the number of velocities."""
        return n_parameters

    def updater(self, system: System, rng: np.random.Generator) -> Updater:  # noqa: ARG002  # nothing is random here
        """Return the same update in numpy, for the reference path."""
        return _Updater(self.learning_rate, self.momentum)


class _Updater(Updater):
    def __init__(self, learning_rate: float, momentum: float) -> None:
        self._learning_rate, self._momentum = learning_rate, momentum
        self._velocity: Array | float = 0.0

    def update(self, view: TrialView) -> Array:
        x, y = view.sampled[-1], view.accelerations[-1]
        slope = 2.0 * (view.predict(x[None])[0] - y) @ view.jacobian(x)
        self._velocity = self._momentum * self._velocity - self._learning_rate * slope
        return view.parameters + self._velocity
