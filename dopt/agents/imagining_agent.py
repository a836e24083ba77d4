"""Plan of MAX: a soft actor-critic that learns in runs imagined by an ensemble."""

from __future__ import annotations

import numpy as np

from dopt.agents.action import input_of
from dopt.agents.normal_ensemble import NormalEnsemble, jensen_renyi_divergence
from dopt.agents.observation import Observation
from dopt.agents.soft_actor_critic import Agent, Settings
from dopt.policies.active_exploration import AGENT_UNITS, ActiveExploration
from dopt.policies.base import Planner
from dopt.systems.base import System
from dopt.trial_view import TrialView
from dopt.types import Array


class ImaginingAgent(Planner):
    """The ensemble and the agent of one trial."""

    def __init__(self, policy: ActiveExploration, system: System, rng: np.random.Generator) -> None:
        self._policy, self._system, self._rng = policy, system, rng
        self._observation = Observation(system)
        sizes = policy.ensemble, len(system.features), policy.units, system.n_learned
        self._ensemble = NormalEnsemble(sizes, policy.learning_rate, rng)
        self._decisions = -(-policy.lookahead // policy.hold)
        settings = Settings(
            units=AGENT_UNITS,
            learning_rate=policy.learning_rate,
            batch_size=policy.batch,
            gamma=policy.discount,
            ent_coef=policy.entropy_weight,
            buffer_size=self._decisions * policy.episodes * policy.actors,
        )
        size, m = self._observation.size, system.n_inputs
        self._agent = Agent(size, m, settings, rng, policy.actors)
        self._action = np.zeros(system.n_inputs)
        self._decided_at = -policy.hold

    def choose(self, view: TrialView) -> Array:
        policy, t = self._policy, view.t
        if t >= policy.warm_up and (t - policy.warm_up) % policy.replan_every == 0:
            self._replan(view)
        if t - self._decided_at >= policy.hold:
            self._decide(view)
        return self._input(self._action)

    def _decide(self, view: TrialView) -> None:
        if view.t < self._policy.warm_up:
            self._action = self._rng.uniform(-1.0, 1.0, self._system.n_inputs)
        else:
            self._action = self._actor(self._observation(view.states[-1]))
        self._decided_at = view.t

    def _replan(self, view: TrialView) -> None:
        """Let the networks learn from all samples, and the agent in runs that they imagine."""
        policy = self._policy
        features = self._system.featurize(view.sampled)
        self._ensemble.fit(features, view.accelerations, policy.fit_updates, policy.batch)
        self._agent.forget()
        for _ in range(policy.episodes):
            self._imagine(view.states[-1])
        self._actor = self._agent.actor()
        self._decided_at = -policy.hold

    def _imagine(self, start: Array) -> None:
        """Imagine runs from a state, (d,), and learn at each decision."""
        policy = self._policy
        states = np.tile(start, (policy.actors, 1))
        observed = self._observation(states)
        mean, variance = self._predicted(states)
        for _ in range(self._decisions):
            actions = self._agent.act(observed)
            rewards = np.zeros(policy.actors)
            for _ in range(policy.hold):
                states = self._following(states, self._input(actions), mean, variance)
                mean, variance = self._predicted(states)
                rewards += jensen_renyi_divergence(mean, variance) / policy.hold
            following = self._observation(states)
            self._agent.remember(observed, actions, rewards, following)
            self._agent.learn(1)
            observed = following

    def _predicted(self, states: Array) -> tuple[Array, Array]:
        return self._ensemble.predict(self._system.featurize(states))

    def _following(self, states: Array, inputs: Array, mean: Array, variance: Array) -> Array:
        """Return the next states, (n, d), each by a network that is drawn for it."""
        system = self._system
        drawn = self._rng.integers(len(mean), size=len(states))
        places = np.arange(len(states))
        noise = self._rng.standard_normal((len(states), system.n_learned))
        accelerations = mean[drawn, places] + np.sqrt(variance[drawn, places]) * noise
        known = system.known(tuple(states.T), tuple(inputs.T), system.parameters)
        rate = np.stack(np.broadcast_arrays(*known, states[:, 0])[:-1], axis=-1)
        rate[:, list(system.learned_rows)] += accelerations
        limit = system.state_limit
        return np.clip(states + system.dt * rate, -limit, limit)

    def _input(self, action: Array) -> Array:
        return input_of(action, self._system.gamma, self._policy.energy)
