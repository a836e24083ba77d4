"""Plan of a soft actor-critic that learns a control task in the run of a trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dopt.agents.action import input_of
from dopt.agents.actor import Actor
from dopt.agents.observation import Observation
from dopt.agents.soft_actor_critic import Agent, Settings
from dopt.control.episode import costs
from dopt.control.task import Goal
from dopt.policies.base import Planner
from dopt.policies.soft_actor_critic import SoftActorCritic
from dopt.systems.base import System
from dopt.trial_view import TrialView
from dopt.types import Array


@dataclass(frozen=True, eq=False)
class ActorFeedback:
    """The mean of an actor as state feedback (:class:`dopt.control.feedback.Feedback`)."""

    actor: Actor
    observation: Observation
    gamma: float
    hold: int
    energy: str

    def __call__(self, state: Array) -> Array:
        return input_of(self.actor(self.observation(state)), self.gamma, self.energy)


class TaskAgent(Planner):
    """The agent of one trial."""

    def __init__(
        self, policy: SoftActorCritic, system: System, goal: Goal, rng: np.random.Generator
    ) -> None:
        self._policy, self._system, self._goal, self._rng = policy, system, goal, rng
        self._observation = Observation(system)
        settings = Settings(
            units=policy.units,
            learning_rate=policy.learning_rate,
            batch_size=policy.batch,
            gamma=policy.discount,
            ent_coef="auto",
            buffer_size=system.horizon // policy.hold + 1,
        )
        self._agent = Agent(self._observation.size, system.n_inputs, settings, rng)
        self._action = np.zeros(system.n_inputs)
        self._decided_at = 0

    def choose(self, view: TrialView) -> Array:
        if self._decided_at == 0 or view.t - self._decided_at == self._policy.hold:
            self._decide(view)
        return input_of(self._action, self._system.gamma, self._policy.energy)

    def feedback(self) -> ActorFeedback:
        policy, gamma = self._policy, self._system.gamma
        actor = self._agent.actor()
        return ActorFeedback(actor, self._observation, gamma, policy.hold, policy.energy)

    def _decide(self, view: TrialView) -> None:
        """Learn from what the last decision brought, and make the next one."""
        policy = self._policy
        observed = self._observation(view.states[-1:])
        if self._decided_at:
            self._remember(view, observed)
        if view.t <= policy.warm_up:
            self._action = self._rng.uniform(-1.0, 1.0, self._system.n_inputs)
        else:
            self._agent.learn(max(1, round(policy.updates * policy.hold)))
            self._action = self._agent.act(observed)[0]
        self._decided_at = view.t

    def _remember(self, view: TrialView, following: Array) -> None:
        since = slice(self._decided_at, None)
        reached, applied = view.states[self._decided_at + 1 :], view.inputs[since]
        reward = -np.mean(costs(self._system, self._goal, reached, applied), keepdims=True)
        before = self._observation(view.states[self._decided_at][None])
        self._agent.remember(before, self._action[None], reward, following)
