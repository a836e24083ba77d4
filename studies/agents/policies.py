"""Agents of reinforcement learning as policies: a soft actor-critic, and MAX with its own planning.

Plug-ins of a launch by ``policy._target_``, derived from :class:`dopt.policies.base.CustomPolicy`:
the plan is given the samples of the trial in numpy and turns them into tensors itself. All of it
is one file, as the digest of the file is part of the key of a trial.

======  ==========================================  ===========
symbol  meaning                                     shape
======  ==========================================  ===========
μ       means that the networks predict             E × N × r
v       variances                                   E × N × r
======  ==========================================  ===========
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from torch import Tensor, nn

from dopt.control.planning import costs, within_ball
from dopt.control.task import Goal
from dopt.fields import parameter
from dopt.policies.base import (
    CustomPolicy,
    Planner,
    TaskPolicy,
    check_ensemble,
    check_length,
    on_sphere,
)
from dopt.systems.base import System
from dopt.trial_view import TrialView
from dopt.types import Array

LIMIT = 10.0
"""Largest size of an observed number."""

SMALLEST_LOG, LARGEST_LOG = -10.0, 4.0
"""Range of the logarithms of variances, in units of the variance of the targets."""

AGENT_UNITS = 64
"""Units of each of the two hidden layers of actor and critics."""


@dataclass(frozen=True, kw_only=True)
class SoftActorCritic(TaskPolicy):
    """Apply the inputs of a soft actor-critic that learns the control task of the trial.

    It is given the negative cost of the task as a reward, and nothing of the system but the
    states, in one run without resets. The trial's model learns from the same samples, so that both
    the agent's own feedback and a planner with the model can be assessed. A decision is held for
    some steps and is one transition; its reward is the mean over them.

    The agent is the one of Stable-Baselines3. Reference: T. Haarnoja et al.,
    "Soft actor-critic algorithms and applications" (2018).

    Parameters
    ----------
    hold : int
        Steps for which an input is held.
    warm_up : int
        First steps, in which decisions are uniform.
    updates : float
        Gradient steps for each step of the trial.
    units : int
        Units of each of the two hidden layers of actor and critics.
    learning_rate : float
        Of actor, critics and the weight of the entropy, which is learned.
    batch : int
        Transitions of a minibatch.
    discount : float
        Discount of the reward from one decision to the next.
    energy : str
        "below": inputs of norm γ at most; "full": always γ, along the agent's action.
    """

    name: ClassVar[str] = "sac"
    reads_inputs: ClassVar[bool] = True

    hold: int = parameter(5, "steps", "positive")
    warm_up: int = parameter(100, "steps", "positive")
    updates: float = parameter(2.0, bound="positive")
    units: int = parameter(64, "units", "positive")
    learning_rate: float = parameter(1e-3, bound="positive")
    batch: int = parameter(128, "transitions", "positive")
    discount: float = parameter(0.98, bound="fraction")
    energy: str = parameter("below", choices=("below", "full"))

    def task_planner(self, system: System, goal: Goal, rng: np.random.Generator) -> Planner:
        return TaskAgent(self, system, goal, rng)


@dataclass(frozen=True, eq=False)
class ActorFeedback:
    """The mean of an actor as state feedback (:class:`dopt.control.task.Feedback`)."""

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


@dataclass(frozen=True, kw_only=True)
class ActiveExploration(CustomPolicy):
    """Apply the inputs of an agent that seeks, in imagined runs, what an ensemble disagrees on.

    The networks of the ensemble predict normal distributions of the accelerations from the features
    of the trial's model, and learn from all samples by their likelihood. Every ``replan_every``
    steps they learn on, and a soft actor-critic learns in runs that are imagined from the current
    state on, each transition by a network that is drawn for it. Its reward is the Jensen-Rényi
    divergence of the distributions at the state that is reached. The mean of the actor is then
    applied until the next plan. The trial's own model is none of these networks: any model and
    learner go with the policy.

    The agent is the one of Stable-Baselines3. Reference: P. Shyam, W. Jaśkowski
    and F. Gomez, "Model-based active exploration" (ICML 2019), algorithm 1. There networks and
    agent are new at each plan and learn far longer; here they go on from the plan before, with the
    transitions imagined anew. :class:`dopt.policies.held_candidates.Disagreement` compares held
    inputs instead.

    Parameters
    ----------
    ensemble : int
        Networks, at least 2.
    units : int
        Units of each of the two hidden layers of every network.
    warm_up : int
        First steps, in which decisions are uniform.
    replan_every : int
        Steps from one plan to the next.
    fit_updates : int
        Gradient steps of the networks at each plan.
    hold : int
        Steps for which a decision is held.
    lookahead : int
        Steps of an imagined run.
    actors : int
        Runs that are imagined at a time.
    episodes : int
        How often that is done for a plan; the agent takes a gradient step at each decision.
    learning_rate : float
        Of networks and agent.
    batch : int
        Samples and transitions of a minibatch.
    discount : float
        Discount of the reward from one decision to the next.
    entropy_weight : float
        Weight of the actor's entropy beside the reward.
    energy : str
        "below": inputs of norm γ at most; "full": always γ, along the agent's action.
    """

    name: ClassVar[str] = "max_agent"
    reads_inputs: ClassVar[bool] = False

    ensemble: int = parameter(8, "networks", "positive")
    units: int = parameter(32, "units", "positive")
    warm_up: int = parameter(25, "steps", "positive")
    replan_every: int = parameter(50, "steps", "positive")
    fit_updates: int = parameter(1000, "updates", "positive")
    hold: int = parameter(2, "steps", "positive")
    lookahead: int = parameter(50, "steps", "positive")
    actors: int = parameter(32, "runs", "positive")
    episodes: int = parameter(10, bound="positive")
    learning_rate: float = parameter(1e-3, bound="positive")
    batch: int = parameter(128, bound="positive")
    discount: float = parameter(0.95, bound="fraction")
    entropy_weight: float = parameter(0.02, bound="positive")
    energy: str = parameter("below", choices=("below", "full"))

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ensemble(self.ensemble)

    def check(self, system: System) -> None:
        check_length("policy.lookahead", self.lookahead, system)

    def planner(self, system: System, rng: np.random.Generator) -> Planner:
        return ImaginingAgent(self, system, rng)


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


class Observation:
    """Map of states to the numbers that an agent is shown, about 1 in size.

    An angle is its cosine and sine, any other component is divided by the half-width of the
    evaluation grid where it has one.
    """

    def __init__(self, system: System) -> None:
        widths = dict(zip(system.grid_indices, system.grid_half_widths, strict=True))
        self._angles = list(system.angle_indices)
        self._others = [i for i in range(system.n_states) if i not in self._angles]
        self._scales = np.array([widths.get(i, 1.0) for i in self._others])

    @property
    def size(self) -> int:
        """Number of observed numbers."""
        return len(self._others) + 2 * len(self._angles)

    def __call__(self, states: Array) -> Array:
        """Return what is observed of states, (..., d), as (..., size)."""
        angles, others = states[..., self._angles], states[..., self._others] / self._scales
        parts = [np.cos(angles), np.sin(angles), np.clip(others, -LIMIT, LIMIT)]
        return np.concatenate(parts, axis=-1)


def input_of(actions: Array, gamma: float, energy: str) -> Array:
    """Return inputs, (..., m), of norm γ or at most γ, for actions, (..., m), within ±1.

    With the full energy the direction of the action counts alone; that of no action is the first.
    """
    if energy == "below":
        return within_ball(gamma * actions, gamma)
    first = np.eye(actions.shape[-1])[0]
    still = np.all(actions == 0.0, axis=-1, keepdims=True)
    return on_sphere(np.where(still, first, actions), gamma)


class NormalEnsemble:
    """Networks with two hidden layers that learn by likelihood, each on minibatches of its own.

    Targets are scaled by their mean and spread at each fit.

    Parameters
    ----------
    shape : (int, int, int, int)
        Networks E, inputs, units of a layer, outputs r.
    learning_rate : float
    rng : numpy.random.Generator
        Draws initial weights and minibatches.
    """

    def __init__(
        self, shape: tuple[int, int, int, int], learning_rate: float, rng: np.random.Generator
    ) -> None:
        self._count, inputs, units, outputs = shape
        self._rng = rng
        sizes = (inputs, units, units, 2 * outputs)
        self._layers = [
            (self._drawn(before, after), torch.zeros(self._count, 1, after, requires_grad=True))
            for before, after in itertools.pairwise(sizes)
        ]
        parameters = [part for layer in self._layers for part in layer]
        self._optimizer = torch.optim.Adam(parameters, lr=learning_rate)
        self._center, self._scale = np.zeros(outputs), np.ones(outputs)

    def _drawn(self, before: int, after: int) -> Tensor:
        values = self._rng.standard_normal((self._count, before, after)) / math.sqrt(before)
        return torch.tensor(values, dtype=torch.float32, requires_grad=True)

    @torch.enable_grad()
    def fit(self, inputs: Array, targets: Array, updates: int, batch: int) -> None:
        """Take gradient steps on inputs (n, ·) and targets (n, r)."""
        spread = targets.std(axis=0)
        self._center, self._scale = targets.mean(axis=0), np.where(spread > 0, spread, 1.0)
        x = torch.tensor(inputs, dtype=torch.float32)
        y = torch.tensor((targets - self._center) / self._scale, dtype=torch.float32)
        for _ in range(updates):
            drawn = torch.from_numpy(self._rng.integers(len(x), size=(self._count, batch)))
            mean, log_variance = self._normal(x[drawn])
            error = (y[drawn] - mean).square() * torch.exp(-log_variance)
            self._optimizer.zero_grad()
            (error + log_variance).mean(dim=(1, 2)).sum().backward()
            self._optimizer.step()

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Return μ and v, (E, N, r) each, in the units of the targets, at inputs (N, ·)."""
        with torch.no_grad():
            x = torch.tensor(inputs, dtype=torch.float32).expand(self._count, -1, -1)
            mean, log_variance = (part.double().numpy() for part in self._normal(x))
        return self._center + self._scale * mean, self._scale**2 * np.exp(log_variance)

    def _normal(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return means and logarithms of variances of scaled targets, at (E, N, ·)."""
        *hidden, (weights, biases) = self._layers
        for hidden_weights, hidden_biases in hidden:
            x = nn.functional.silu(torch.baddbmm(hidden_biases, x, hidden_weights))
        mean, raw = torch.baddbmm(biases, x, weights).chunk(2, dim=2)
        share = torch.sigmoid(raw)
        return mean, SMALLEST_LOG + (LARGEST_LOG - SMALLEST_LOG) * share


def jensen_renyi_divergence(mean: Array, variance: Array) -> Array:
    """Return the divergence of normal distributions of equal weight, (N,), from μ and v.

    It is the quadratic Rényi entropy of their mixture less the mean of theirs: 0 where all are the
    same, and log E where none overlap, if all have the same variances.
    """
    E = len(mean)
    between = variance[:, None] + variance[None]
    apart = (mean[:, None] - mean[None]) ** 2 / between
    logs = -0.5 * np.sum(apart + np.log(2.0 * math.pi * between), axis=3)
    largest = logs.max(axis=(0, 1))
    mixture = 2.0 * math.log(E) - largest - np.log(np.exp(logs - largest).sum(axis=(0, 1)))
    own = 0.5 * np.sum(np.log(4.0 * math.pi * variance), axis=2).mean(axis=0)
    divergence: Array = mixture - own
    return divergence


@dataclass(frozen=True)
class Settings:
    """Settings of the learning, by their names in Stable-Baselines3, except ``units``.

    Attributes
    ----------
    units : int
        Units of each of the two hidden layers of actor and critics.
    ent_coef : float or str
        Weight of the entropy, or "auto" for one that is learned.
    """

    units: int
    learning_rate: float
    batch_size: int
    gamma: float
    ent_coef: float | str
    buffer_size: int


class Agent:
    """Actor and critics, and the transitions that they learn from.

    Parameters
    ----------
    n_observed, n_inputs : int
        Numbers of an observation and of an action, whose entries are within ±1.
    n_actors : int
        Transitions that come at a time.
    rng : numpy.random.Generator
        Seeds all that is random in it.
    """

    def __init__(
        self,
        n_observed: int,
        n_inputs: int,
        settings: Settings,
        rng: np.random.Generator,
        n_actors: int = 1,
    ) -> None:
        self._settings = settings
        self._randomness = GlobalRandomness(int(rng.integers(2**32)))
        spaces = _Spaces(n_observed, n_inputs)
        with self._randomness.lent():
            self._sac = SAC(
                "MlpPolicy",
                spaces,
                learning_rate=settings.learning_rate,
                buffer_size=1,
                batch_size=settings.batch_size,
                gamma=settings.gamma,
                ent_coef=settings.ent_coef,
                policy_kwargs={"net_arch": [settings.units, settings.units]},
                device="cpu",
            )
        self._sac.set_logger(Logger(folder=None, output_formats=[]))
        self._buffer = ReplayBuffer(
            settings.buffer_size,
            spaces.observation_space,
            spaces.action_space,
            device="cpu",
            n_envs=n_actors,
            handle_timeout_termination=False,
        )
        self._sac.replay_buffer = self._buffer

    def act(self, observed: Array) -> Array:
        """Return actions drawn for observations, (n, n_observed): (n, n_inputs)."""
        with self._randomness.lent():
            drawn, _ = self._sac.predict(observed.astype(np.float32))
        actions: Array = drawn.astype(np.float64)
        return actions

    def remember(self, observed: Array, actions: Array, rewards: Array, following: Array) -> None:
        """Keep transitions, one of each actor: rows of (n_actors, ·), rewards (n_actors,)."""
        over = np.zeros(len(rewards))  # a run goes on after each of them
        self._buffer.add(observed, following, actions, rewards, over, [{}] * len(rewards))

    def forget(self) -> None:
        """Drop all transitions."""
        self._buffer.reset()

    def learn(self, updates: int) -> None:
        """Take gradient steps on minibatches of what is kept."""
        with self._randomness.lent(), torch.enable_grad():
            self._sac.train(updates, self._settings.batch_size)

    def actor(self) -> Actor:
        """Return the actor as it is now, without noise."""
        layers = [*self._sac.actor.latent_pi, self._sac.actor.mu]
        linear = [layer for layer in layers if hasattr(layer, "weight")]
        arrays = [(one.weight.detach().numpy(), one.bias.detach().numpy()) for one in linear]
        return Actor(tuple((w.astype(float), b.astype(float)) for w, b in arrays))


class _Spaces(gymnasium.Env):
    """The spaces of observations and actions, which is all that is asked of an environment here."""

    def __init__(self, n_observed: int, n_inputs: int) -> None:
        self.observation_space = Box(-np.inf, np.inf, (n_observed,), np.float32)
        self.action_space = Box(-1.0, 1.0, (n_inputs,), np.float32)


@dataclass(frozen=True, eq=False)
class Actor:
    """A network with rectified layers and tanh at its end.

    Attributes
    ----------
    layers : tuple of ((outputs, inputs), (outputs,))
        Weights and biases, from the first layer to the last.
    """

    layers: tuple[tuple[Array, Array], ...]

    def __call__(self, observed: Array) -> Array:
        """Return the actions, (..., m), within ±1, for observations (..., n_observed)."""
        *hidden, last = self.layers
        for weights, biases in hidden:
            observed = np.maximum(observed @ weights.T + biases, 0.0)
        weights, biases = last
        action: Array = np.tanh(observed @ weights.T + biases)
        return action


class GlobalRandomness:
    """States of the global generators of Python, numpy and torch that one agent goes on from.

    Parameters
    ----------
    seed : int
        Seed of all three, below 2^32.
    """

    def __init__(self, seed: int) -> None:
        with _kept():
            random.seed(seed)
            np.random.seed(seed)  # noqa: NPY002  # the generator that the library draws from
            torch.manual_seed(seed)
            self._states = _states()

    @contextmanager
    def lent(self) -> Iterator[None]:
        """Lend the global generators to the agent; afterwards they are as before."""
        with _kept():
            _restore(self._states)
            yield
            self._states = _states()


@contextmanager
def _kept() -> Iterator[None]:
    before = _states()
    try:
        yield
    finally:
        _restore(before)


def _states() -> tuple[Any, ...]:
    return random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002


def _restore(states: tuple[Any, ...]) -> None:
    own, numpy_state, torch_state = states
    random.setstate(own)
    np.random.set_state(numpy_state)  # noqa: NPY002
    torch.set_rng_state(torch_state)
