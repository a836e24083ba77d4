"""Policies that compare candidate inputs, each held along the model's prediction.

The paper's references [8], the predictive entropy of a Gaussian process, and [10], the disagreement
of an ensemble of networks (MAX), and space filling by distances of features and of accelerations.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.learning import Adam, AdamWindow
from dopt.models import MLP
from dopt.policies.base import Array, CustomPolicy, Planner, check_ensemble, check_length
from dopt.policies.search import CandidatePolicy
from dopt.systems.base import System, next_state
from dopt.trial_view import TrialView


@dataclass(frozen=True, kw_only=True)
class HeldCandidates(CandidatePolicy):
    """Predict where each of some inputs leads if it is held, and apply the best of them.

    Parameters
    ----------
    lookahead : int
        Steps for which a candidate is held in prediction.
    candidates : int
        As of :class:`dopt.policies.search.CandidatePolicy`.
    """

    lookahead: int = parameter(1, "steps", "positive")

    def check(self, system: System) -> None:
        check_length("policy.lookahead", self.lookahead, system)

    def steps(self, system: System) -> int:
        """Return the number of steps H of a plan."""
        return self.lookahead + system.lead_steps


@dataclass(frozen=True, kw_only=True)
class GaussianProcessEntropy(HeldCandidates):
    """Maximise the predictive entropy of a Gaussian process at the states that an input leads to.

    Each candidate input is held for ``lookahead`` steps of the mean prediction; its value is the
    joint entropy ½ log det(K_post + σ²/dt I) of the accelerations that would be observed there: one
    step is the predictive variance at the next state. It goes with ``model=gaussian_process`` and
    ``learner=conditioning``. Reference: M. Buisson-Fenet, F. Solowjow and S. Trimpe, "Actively
    learning Gaussian process dynamics" (L4DC 2020).
    """

    name: ClassVar[str] = "gaussian_process"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.policies.plan_held_candidates"


@dataclass(frozen=True, kw_only=True)
class Disagreement(HeldCandidates, CustomPolicy):
    """Maximise how much networks with other initial weights disagree about where the input leads.

    K networks learn from the same samples by the same learner. The trial's own network is the first
    of them and is what the loss evaluates: the paper compares policies at one model f_θ. The others
    serve the plan alone, and their initial weights come from a stream of their own.

    Each candidate input is held for ``lookahead`` steps of the mean prediction of the ensemble; its
    value is the sum, over the states visited and the learned components, of the variance across the
    ensemble of the accelerations predicted there. One step already leads to the next state: what is
    predicted *at* x_t does not depend on u_t, for the input term is known.

    The variance stands for the Jensen-Rényi divergence of the original: with networks that predict
    a mean, and noise as small as it is here, each network is far outside the others' noise, where
    that divergence is log K for every input. Reference: P. Shyam, W. Jaśkowski and F. Gomez,
    "Model-based active exploration" (ICML 2019).

    Parameters
    ----------
    ensemble : int
        K, networks in all, at least 2.
    lookahead, candidates
        As of :class:`dopt.policies.held_candidates.HeldCandidates`.
    """

    name: ClassVar[str] = "max"
    compiled: ClassVar[bool] = True

    ensemble: int = parameter(5, "networks", "positive")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ensemble(self.ensemble)

    def planner(self, system: System, rng: np.random.Generator) -> Planner:
        return self.network_planner(system, MLP(), AdamWindow(), rng)

    def network_planner(
        self, system: System, model: MLP, learner: Adam, rng: np.random.Generator
    ) -> Planner:
        """Return the plan of a new trial whose networks learn as the trial's own."""
        return DisagreementPlan(self, system, model, learner, rng)


class DisagreementPlan(Planner):
    """The plan of one trial, with K - 1 networks beside the trial's own, (K - 1, q)."""

    def __init__(
        self,
        policy: Disagreement,
        system: System,
        model: MLP,
        learner: Adam,
        rng: np.random.Generator,
    ) -> None:
        self._system, self._model, self._learner = system, model, learner
        self._steps = policy.steps(system)
        self._inputs = policy.compared_inputs(system)
        draw = functools.partial(model.initial_parameters, system, rng)
        self._others = np.array([draw() for _ in range(policy.ensemble - 1)])
        self._moments, self._done = np.zeros((2, *self._others.shape)), 0

    def choose(self, view: TrialView) -> Array:
        best: Array = self._inputs[np.argmax(self.worth(view))]
        return best

    def worth(self, view: TrialView) -> Array:
        """Return what each candidate is worth, (C,)."""
        members = np.concatenate([view.parameters[None], self._others])
        rate = functools.partial(self._rate, members)
        states = np.repeat(view.states[-1:], len(self._inputs), axis=0)
        worth = np.zeros(len(states))
        for _ in range(self._steps):
            states = next_state(self._system.integrator, rate, states, self._system.dt)
            worth += self._predict(members, states).var(axis=0).sum(axis=1)
        return worth

    def _rate(self, members: Array, states: Array) -> Array:
        """Return dx/dt by the mean of the networks, (C, d), at a state for each candidate."""
        rate = self._system.known_flow(states, self._inputs)
        rate[:, list(self._system.learned_rows)] += self._predict(members, states).mean(axis=0)
        return rate

    def observe(self, view: TrialView) -> None:
        """Train the other networks by the learning step of the trial's own."""
        newest = slice(-self._learner.window, None)
        states, targets = view.sampled[newest], view.accelerations[newest]
        gradient = self._loss_gradient(self._others, states, targets)
        self._done += 1
        self._adam_step(self._others, self._moments, gradient, self._done)

    def _predict(self, parameters: Array, states: Array) -> Array:
        """Return the accelerations of each network, (K, N, r), at states (N, d)."""
        return self._values(parameters, states)[-1]

    def _values(self, parameters: Array, states: Array) -> list[Array]:
        """Return the values of all layers of each network, (K, N, ·), the features first."""
        features = self._system.featurize(states)
        values = [np.broadcast_to(features, (len(parameters), *features.shape))]
        layers = self._model.weights(self._system, parameters)
        for i, (W, b) in enumerate(layers):
            sums = values[-1] @ W.swapaxes(1, 2) + b[:, None]
            values.append(np.tanh(sums) if i + 1 < len(layers) else sums)
        return values

    def _loss_gradient(self, parameters: Array, states: Array, targets: Array) -> Array:
        """Return the gradient of mean_n ‖a_θ(x_n) - y_n‖² by each θ, (K, q)."""
        values = self._values(parameters, states)
        layers = self._model.weights(self._system, parameters)
        delta = 2.0 / len(states) * (values[-1] - targets)
        parts: list[Array] = []
        for i in range(len(layers) - 1, -1, -1):
            below = values[i]
            slope = (delta.swapaxes(1, 2) @ below).reshape(len(parameters), -1)
            parts = [slope, delta.sum(axis=1), *parts]
            delta = (delta @ layers[i][0]) * (1.0 - below**2)
        return np.concatenate(parts, axis=1)

    def _adam_step(self, parameters: Array, moments: Array, gradient: Array, step: int) -> None:
        """Take Adam's step of a number, from 1, in place; moments are (2, K, q)."""
        rule, (first, second) = self._learner, moments
        first += (1.0 - rule.beta_1) * (gradient - first)
        second += (1.0 - rule.beta_2) * (gradient**2 - second)
        deviation = np.sqrt(second / (1.0 - rule.beta_2**step)) + rule.epsilon
        parameters -= rule.learning_rate * first / (1.0 - rule.beta_1**step) / deviation


NEAREST = 1e-12
"""Squared distance from which on two places are told apart."""

LARGEST_EXPONENT = 700.0
"""Below that at which exp overflows."""


@dataclass(frozen=True, kw_only=True)
class SpaceFilling(HeldCandidates, CustomPolicy):
    """Apply the input that leads farthest from the samples, without an information matrix.

    Each candidate is held for ``lookahead`` predicted steps. With φ the features of the state
    that it leads to, and of u/γ where the model reads inputs, φ_s the samples' features, y and y_s
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
    """The plan of one trial: it looks at all samples at each step."""

    def __init__(self, policy: SpaceFilling, system: System) -> None:
        self._policy, self._system = policy, system
        self._inputs = policy.compared_inputs(system)

    def choose(self, view: TrialView) -> Array:
        inputs = self._inputs[np.argsort(-(self._inputs @ view.tie))]
        best: Array = inputs[np.argmax(self.worth(view, inputs))]
        return best

    def worth(self, view: TrialView, inputs: Array) -> Array:
        """Return what each of some inputs, (C, m), is worth, (C,)."""
        reached = view.held(inputs, self._policy.steps(view.system))
        points = view.points(reached, inputs)
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
