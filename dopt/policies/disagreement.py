"""Exploration by the disagreement of an ensemble of networks (MAX), reference [10] of the paper."""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.learning import Adam, AdamWindow
from dopt.models import MLP
from dopt.policies.base import Array, CustomPolicy, Planner, check_ensemble
from dopt.policies.held_candidates import HeldCandidates
from dopt.systems.base import System, next_state
from dopt.trial_view import TrialView


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
        return DisagreementPlan(self, system, Networks(system, model, learner), rng)


class DisagreementPlan(Planner):
    """The plan of one trial, with the networks beside the trial's own."""

    def __init__(
        self,
        policy: Disagreement,
        system: System,
        networks: Networks,
        rng: np.random.Generator,
    ) -> None:
        self._system, self._networks, self._steps = system, networks, policy.lookahead
        self._inputs = policy.compared_inputs(system)
        drawn = [networks.initial_parameters(rng) for _ in range(policy.ensemble - 1)]
        self._others = np.array(drawn)
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
            worth += self._networks.predict(members, states).var(axis=0).sum(axis=1)
        return worth

    def _rate(self, members: Array, states: Array) -> Array:
        """Return dx/dt by the mean of the networks, (C, d), at a state for each candidate."""
        system = self._system
        known = system.known(tuple(states.T), tuple(self._inputs.T), system.parameters)
        rate = np.stack(np.broadcast_arrays(*known, states[:, 0])[:-1], axis=-1)
        rate[:, list(system.learned_rows)] += self._networks.predict(members, states).mean(axis=0)
        return rate

    def observe(self, view: TrialView) -> None:
        """Let the other networks take the learning step of the trial's own."""
        newest = slice(-self._networks.learner.window, None)
        states, targets = view.sampled[newest], view.accelerations[newest]
        gradient = self._networks.loss_gradient(self._others, states, targets)
        self._done += 1
        self._networks.adam_step(self._others, self._moments, gradient, self._done)


class Networks:
    """Networks of one architecture that learn together; parameters are (K, q)."""

    def __init__(self, system: System, model: MLP, learner: Adam) -> None:
        self._system, self._model, self.learner = system, model, learner

    def initial_parameters(self, rng: np.random.Generator) -> Array:
        """Return the parameters of one network before it learns, (q,)."""
        return self._model.initial_parameters(self._system, rng)

    def predict(self, parameters: Array, states: Array) -> Array:
        """Return the accelerations of each network, (K, N, r), at states (N, d)."""
        return self._values(parameters, states)[-1]

    def _values(self, parameters: Array, states: Array) -> list[Array]:
        """Return the values of all layers of each network, (K, N, ·), the features first."""
        features = self._system.featurize(states)
        values = [np.broadcast_to(features, (len(parameters), *features.shape))]
        layers = self._layers(parameters)
        for i, (W, b) in enumerate(layers):
            sums = values[-1] @ W.swapaxes(1, 2) + b[:, None]
            values.append(np.tanh(sums) if i + 1 < len(layers) else sums)
        return values

    def _layers(self, parameters: Array) -> list[tuple[Array, Array]]:
        """Return views of the weights, (K, outputs, inputs), and biases of each layer."""
        sizes, first, layers = self._model.layer_sizes(self._system), 0, []
        for n_in, n_out in itertools.pairwise(sizes):
            middle, last = first + n_in * n_out, first + (n_in + 1) * n_out
            W = parameters[:, first:middle].reshape(len(parameters), n_out, n_in)
            layers.append((W, parameters[:, middle:last]))
            first = last
        return layers

    def loss_gradient(self, parameters: Array, states: Array, targets: Array) -> Array:
        """Return the gradient of mean_n ‖a_θ(x_n) - y_n‖² by each θ, (K, q)."""
        values, layers = self._values(parameters, states), self._layers(parameters)
        delta = 2.0 / len(states) * (values[-1] - targets)
        parts: list[Array] = []
        for i in range(len(layers) - 1, -1, -1):
            below = values[i]
            slope = (delta.swapaxes(1, 2) @ below).reshape(len(parameters), -1)
            parts = [slope, delta.sum(axis=1), *parts]
            delta = (delta @ layers[i][0]) * (1.0 - below**2)
        return np.concatenate(parts, axis=1)

    def adam_step(self, parameters: Array, moments: Array, gradient: Array, step: int) -> None:
        """Take Adam's step of a number, from 1, in place; moments are (2, K, q)."""
        rule, (first, second) = self.learner, moments
        first += (1.0 - rule.beta_1) * (gradient - first)
        second += (1.0 - rule.beta_2) * (gradient**2 - second)
        deviation = np.sqrt(second / (1.0 - rule.beta_2**step)) + rule.epsilon
        parameters -= rule.learning_rate * first / (1.0 - rule.beta_1**step) / deviation
