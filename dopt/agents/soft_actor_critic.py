"""Soft actor-critic of Stable-Baselines3, fed by hand: who acts and who steps is the caller's."""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger

from dopt.agents.actor import Actor
from dopt.agents.global_randomness import GlobalRandomness
from dopt.types import Array


@dataclass(frozen=True)
class Settings:
    """Settings of the learning, by their names in Stable-Baselines3 but for ``units``.

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
