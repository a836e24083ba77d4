"""A Gymnasium environment as a system that is explored as a black box."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from dopt.declare.validated_fields import parameter
from dopt.errors import SpecificationError
from dopt.systems.base import Array
from dopt.systems.black_box import BlackBox, Episode, check_amplitude, check_step


@dataclass(frozen=True, kw_only=True)
class Environment(BlackBox):
    """An environment with a continuous ``Box`` of actions whose observation gives the state.

    A subclass names the environment and declares what :class:`BlackBox` asks for, and
    :meth:`state`, the map from an observation to the state. Positions must be among what is
    observed with their rates: an environment that shows less is none for this package. Components
    in ``angle_indices`` are followed over the full turn.

    ``dt`` has to be the time between two steps of the environment, γ within the box of its actions.
    An input beyond the box is cut to it, and what was applied is what counts. An episode that the
    environment terminates ends the trial as diverged; its limit of time is lifted.

    Parameters
    ----------
    id : str
        Its name for ``gymnasium.make``, such as ``Pendulum-v1``.
    """

    id: str = parameter("")

    @staticmethod
    @abstractmethod
    def state(observation: Any) -> Sequence[float]:
        """Return the state, d numbers, that an observation shows."""

    def make(self) -> gymnasium.Env:
        """Return a new environment without a limit of time."""
        return gymnasium.make(self.id, max_episode_steps=-1, disable_env_checker=True)

    def episode(self, seed: int) -> Episode:
        """Start a run; see :class:`BlackBox`.

        Raises
        ------
        SpecificationError
            If the environment cannot be made, or is not what was declared.
        """
        try:
            environment = self.make()
        except gymnasium.error.Error as error:
            raise SpecificationError(
                f"env.id is '{self.id}', which Gymnasium cannot make ({error}): give the id of an "
                f"environment that is installed."
            ) from error
        _check_actions(self, environment)
        check_step(self, getattr(environment.unwrapped, "dt", self.dt), self.id)
        return _Episode(self, environment, seed)


class _Episode:
    """An episode of an environment, with its angles over the full turn."""

    def __init__(self, system: Environment, environment: gymnasium.Env, seed: int) -> None:
        self._system, self._environment = system, environment
        self._angles = list(system.angle_indices)
        box = environment.action_space
        assert isinstance(box, Box)
        self._low, self._high, self._kind = box.low, box.high, box.dtype
        observation, _ = environment.reset(seed=seed % 2**31)
        self._state = self._read(observation)
        self._over = False

    @property
    def state(self) -> Array:
        return self._state.copy()

    def step(self, inputs: Array) -> Array:
        applied: Array = np.clip(inputs, self._low, self._high)
        if self._over or not np.isfinite(applied).all():
            self._state = np.full_like(self._state, np.nan)
            return applied
        observation, _, self._over, _, _ = self._environment.step(applied.astype(self._kind))
        reached = self._read(observation)
        turns = (self._state - reached)[self._angles] / (2 * math.pi)
        reached[self._angles] += 2 * math.pi * np.round(turns)
        self._state = np.full_like(reached, np.nan) if self._over else reached
        return applied

    def _read(self, observation: Any) -> Array:
        state = np.array(self._system.state(observation), dtype=np.float64)
        if state.shape != (self._system.n_states,):
            raise SpecificationError(
                f"env '{self._system.name}' makes a state of shape {state.shape} of an "
                f"observation, but {(self._system.n_states,)} is expected: correct its state()."
            )
        return state


def _check_actions(system: Environment, environment: gymnasium.Env) -> None:
    box = environment.action_space
    if not isinstance(box, Box) or box.shape != (system.n_inputs,):
        raise SpecificationError(
            f"the actions of {system.id} are {box}, but a Box of {system.n_inputs} numbers is "
            f"expected: take an environment with continuous actions, and label each of them."
        )
    check_amplitude(system, box.low, box.high, f"actions of {system.id}")
