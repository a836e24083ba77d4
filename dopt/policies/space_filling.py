"""Space filling: samples far from all others, by distances of features and of accelerations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.policies.base import Array, CustomPolicy, Planner
from dopt.policies.held_candidates import HeldCandidates
from dopt.systems.base import System
from dopt.trial_view import TrialView

NEAREST = 1e-12
"""Squared distance from which on two places are told apart."""

LARGEST_EXPONENT = 700.0
"""Below that at which exp overflows."""


@dataclass(frozen=True, kw_only=True)
class SpaceFilling(HeldCandidates, CustomPolicy):
    """Apply the input that leads farthest from the samples, without an information matrix.

    Each candidate is held for ``lookahead`` predicted steps. With φ the features of the state
    that it leads to, and of u/γ where the model reads inputs, φ_s those of the samples, y and y_s
    the predicted and the observed accelerations, each by the standard deviation of the latter, it
    is worth

    ========== =====================================================================
    ``gsx``    min_s ‖φ - φ_s‖
    ``igs``    min_s ‖φ - φ_s‖ ‖y - y_s‖
    ``idw``    Σ_s v_s ‖y - y_s‖² + δ (2/π) arctan(1 / Σ_s w_s), with the weights of inverse
               distances w_s = exp(-‖φ - φ_s‖²) / ‖φ - φ_s‖² and their shares v_s = w_s / Σ w
    ========== =====================================================================

    Of inputs of equal worth it is the one nearest to a random direction.

    References: D. Wu, C.-T. Lin and J. Huang, "Active learning for regression using greedy
    sampling" (Information Sciences 2019), for the first two; A. Bemporad, "Active learning for
    regression by inverse distance weighting" (Information Sciences 2023), for the third.

    Parameters
    ----------
    criterion : {"gsx", "igs", "idw"}
        Worth of a place.
    weight : float
        δ of ``idw``.
    """

    name: ClassVar[str] = "space_filling"
    compiled: ClassVar[bool] = True
    reads_inputs: ClassVar[bool] = True

    criterion: str = parameter("idw", choices=("gsx", "igs", "idw"))
    weight: float = parameter(1.0, bound="nonnegative")

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002  # ties are broken by the trial's
        return SpaceFillingPlan(self, system)


class SpaceFillingPlan(Planner):
    """The plan of one trial: it looks at all samples anew at each step."""

    def __init__(self, policy: SpaceFilling, system: System) -> None:
        self._policy, self._system = policy, system
        self._inputs = policy.compared_inputs(system)

    def choose(self, view: TrialView) -> Array:
        inputs = self._inputs[np.argsort(-(self._inputs @ view.tie))]
        best: Array = inputs[np.argmax(self.worth(view, inputs))]
        return best

    def worth(self, view: TrialView, inputs: Array) -> Array:
        """Return what each of some inputs, (C, m), is worth, (C,)."""
        points = view.points(self._led_to(view, inputs), inputs)
        samples = view.points(view.sampled, view.sampled_inputs)
        apart = _squared_distances(self._features(points), self._features(samples))
        if self._policy.criterion == "gsx":
            return _root_of_least(apart)
        spread = view.accelerations.std(axis=0)
        scale = np.where(spread > 0, spread, 1.0)
        differing = _squared_distances(view.predict(points) / scale, view.accelerations / scale)
        if self._policy.criterion == "igs":
            return _root_of_least(apart * differing)
        return _by_inverse_distances(apart, differing, self._policy.weight)

    def _led_to(self, view: TrialView, inputs: Array) -> Array:
        """Return the states, (C, d), after ``lookahead`` predicted steps with inputs, (C, m)."""
        states = view.following(view.states[-1], inputs)
        for _ in range(self._policy.lookahead - 1):
            following = (view.following(x, u[None]) for x, u in zip(states, inputs, strict=True))
            states = np.concatenate(list(following))
        return states

    def _features(self, points: Array) -> Array:
        """Return the features of states with inputs, (N, ·), behind them where they are read."""
        d = self._system.n_states
        features = self._system.featurize(points[:, :d])
        return np.concatenate([features, points[:, d:] / self._system.gamma], axis=1)


def _squared_distances(these: Array, those: Array) -> Array:
    """Return squared distances, (N, M), between rows (N, k) and (M, k)."""
    distances: Array = np.sum((these[:, None] - those[None]) ** 2, axis=2)
    return distances


def _root_of_least(squares: Array) -> Array:
    """Return the root of the least of each row, (C,)."""
    least: Array = np.sqrt(squares.min(axis=1))
    return least


def _by_inverse_distances(apart: Array, differing: Array, weight: float) -> Array:
    """Return ``idw``, (C,), from squared distances to samples, (C, N) each, and δ."""
    apart = np.maximum(apart, NEAREST)
    logarithms = -apart - np.log(apart)
    largest = logarithms.max(axis=1)
    weights = np.exp(logarithms - largest[:, None])  # by the largest of them
    total = weights.sum(axis=1)
    inverse = np.exp(np.minimum(-largest - np.log(total), LARGEST_EXPONENT))
    spread = np.sum(weights * differing, axis=1) / total
    values: Array = spread + weight * np.arctan(inverse) * 2.0 / math.pi
    return values
