"""Gymnasium adapters: its environments as systems, and the systems as its environments.

It needs the extra ``gymnasium``. Importing this module makes the systems known to
``gymnasium.make`` as ``dopt/Pendulum-v0`` and so on.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from dopt.arguments import instance
from dopt.errors import DoptError, SpecificationError
from dopt.fields import parameter, unvalidated
from dopt.models import MLP
from dopt.policies.base import on_sphere
from dopt.systems import SYSTEMS, System, system_from_mapping
from dopt.systems.base import Array, next_state
from dopt.systems.black_box import ROUNDING, BlackBox, check_amplitude, check_step

TRIED_STEPS = 10_000
"""Most steps of the run in which an environment is tried out before the first trial."""

REPEATED_STEPS = 20
"""First steps of that run, which are taken again by another environment with the same seed."""


@dataclass(frozen=True, kw_only=True)
class Environment(BlackBox):
    """An environment with a continuous ``Box`` of actions whose observation gives the state.

    A subclass names the environment and declares what :class:`BlackBox` asks for, and
    :meth:`state`, the map from an observation to the state. Positions must be among what is
    observed with their rates: an environment that shows less cannot be used. Components
    in ``angle_indices`` are followed over the full turn.

    ``dt`` has to be the time between two steps of the environment, γ within the box of its actions.
    An input beyond the box is cut to it, and to a whole number towards 0 in a box of integers: what
    was applied is recorded, and is what counts. An episode that the environment terminates ends the
    trial as diverged; its limit of time is lifted.

    Before the first trial a run of random inputs is tried out. An environment that truncates its
    episodes within the horizon is refused, unless ``restarts`` is true: then it is reset each time,
    with a seed that follows from the trial's, and the step is taken from there with the same input.
    The truncated step itself is left out: nothing is learned from it.

    Parameters
    ----------
    id : str
        Its name for ``gymnasium.make``, such as ``Pendulum-v1``.
    restarts : bool
        Whether it is explored in pieces where it truncates its episodes.
    """

    id: str = parameter("")
    restarts: bool = unvalidated(False, added=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        instance("env.restarts", self.restarts, bool, "true or false")

    @staticmethod
    @abstractmethod
    def state(observation: Any) -> Sequence[float]:
        """Return the state, d numbers, that an observation shows."""

    def make(self) -> gymnasium.Env:
        """Return a new environment without a limit of time."""
        return gymnasium.make(self.id, max_episode_steps=-1, disable_env_checker=True)

    def episode(self, seed: int) -> _Episode:
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
        declared = (getattr(environment.unwrapped, name, None) for name in ("dt", "tau"))
        seconds = (float(one) for one in declared if isinstance(one, int | float | np.number))
        check_step(self, next(seconds, self.dt), self.id)
        return _Episode(self, environment, seed)

    def try_out(self) -> None:
        """Take the steps of a run twice; see :class:`BlackBox`.

        Raises
        ------
        SpecificationError
            If the environment is not what was declared, or fails, or its seed does not decide
            about its states.
        """
        try:
            states = _tried_states(self, min(self.horizon, TRIED_STEPS))
            again = _tried_states(self, min(self.horizon, REPEATED_STEPS))
        except DoptError:
            raise
        except Exception as error:
            raise SpecificationError(
                f"{self.id} fails when it is tried out ({type(error).__name__}: {error}), but "
                f"reset(seed=...) with an observation and info is expected, and step(action) with "
                f"an observation, a reward, terminated, truncated and info: correct it, or wrap it "
                f"if it is older than Gymnasium 0.26."
            ) from error
        if not np.allclose(states[: len(again)], again, rtol=ROUNDING, atol=ROUNDING):
            raise SpecificationError(
                f"{self.id} reaches other states with the same seed and inputs, but the seed of "
                f"reset() has to decide about them: draw its random numbers from self.np_random."
            )


class _Episode:
    """An episode of an environment, with its angles over the full turn.

    Attributes
    ----------
    new_start : (d,) or None
        See :class:`dopt.systems.black_box.Episode`.
    over : bool
        Whether the environment has terminated it.
    """

    def __init__(self, system: Environment, environment: gymnasium.Env, seed: int) -> None:
        self._system, self._environment = system, environment
        self._angles = list(system.angle_indices)
        box = environment.action_space
        assert isinstance(box, Box)
        self._low, self._high, self._kind = box.low, box.high, box.dtype
        self._seed, self._pieces, self._steps = seed, 0, 0
        self._state = self._reset(seed)
        self.new_start: Array | None = None
        self.over = False

    @property
    def state(self) -> Array:
        return self._state.copy()

    def step(self, inputs: Array) -> Array:
        self.new_start = None
        if self.over or not np.isfinite(inputs).all():
            self._state = np.full_like(self._state, np.nan)
            return inputs
        sent = np.clip(inputs, self._low, self._high).astype(self._kind)
        applied: Array = sent.astype(np.float64)
        reached, truncated = self._advance(sent)
        if truncated:
            self._restart()
            reached, truncated = self._advance(sent)
        if truncated:
            raise self._truncated("its first step")
        self._steps += 1
        turns = (self._state - reached)[self._angles] / (2 * math.pi)
        reached[self._angles] += 2 * math.pi * np.round(turns)
        self._state = reached
        return applied

    def _advance(self, action: Any) -> tuple[Array, bool]:
        """Return the state that follows, (d,), NaN at the end, and if the episode is cut short."""
        observation, _, self.over, truncated, _ = self._environment.step(action.copy())
        reached = self._read(observation)
        if self.over:
            return np.full_like(reached, np.nan), False
        return reached, bool(truncated)

    def _restart(self) -> None:
        if not self._system.restarts:
            raise self._truncated(f"step {self._steps + 1}")
        self._pieces, self._steps = self._pieces + 1, 0
        drawn = np.random.SeedSequence(self._seed, spawn_key=(self._pieces,))
        self._state = self._reset(int(drawn.generate_state(1)[0]))
        self.new_start = self._state.copy()

    def _reset(self, seed: int) -> Array:
        observation, _ = self._environment.reset(seed=seed % 2**31)
        return self._read(observation)

    def _read(self, observation: Any) -> Array:
        state = np.array(self._system.state(observation), dtype=np.float64)
        if state.shape != (self._system.n_states,):
            raise SpecificationError(
                f"env '{self._system.name}' makes a state of shape {state.shape} of an "
                f"observation, but {(self._system.n_states,)} is expected: correct its state()."
            )
        return state

    def _truncated(self, when: str) -> SpecificationError:
        return SpecificationError(
            f"{self._system.id} truncates its episode at {when}, but a trial takes "
            f"{self._system.horizon}, and cannot learn across a restart: set env.horizon below "
            f"that, or give ++env.restarts=true to explore in pieces."
        )


def _tried_states(system: Environment, steps: int) -> Array:
    """Return the states that follow, (steps, d), under random inputs, in as many runs as needed."""
    inputs = np.random.default_rng(0).standard_normal((steps, system.n_inputs))
    states = np.empty((steps, system.n_states))
    episode, seed = system.episode(0), 0
    for t, u in enumerate(on_sphere(inputs, system.gamma)):
        episode.step(u)
        states[t] = episode.state
        if not (episode.over or np.isfinite(states[t]).all()):
            raise SpecificationError(
                f"{system.id} shows the state {states[t]} after {t + 1} random inputs of norm "
                f"{system.gamma:g}, but finite numbers are expected until it terminates: correct "
                f"it, or lower env.gamma."
            )
        if not np.all(np.abs(states[t]) <= system.state_limit):
            seed += 1
            episode, states[t] = system.episode(seed), 0.0
    return states


def _check_actions(system: Environment, environment: gymnasium.Env) -> None:
    box = environment.action_space
    if not isinstance(box, Box) or box.shape != (system.n_inputs,):
        raise SpecificationError(
            f"the actions of {system.id} are {box}, but a Box of {system.n_inputs} numbers is "
            f"expected: take an environment with continuous actions, and label each of them."
        )
    check_amplitude(system, box.low, box.high, f"actions of {system.id}")


UNITS = 64
"""Random features in which the information is counted."""

REGULARIZATION = 1e-3
_SEED = 0


class Exploration(gymnasium.Env):
    """Equation 2 of the paper as an environment: explore a system with bounded energy.

    ========== =====================================================================
    observed   the state x_t, (d,), in the units of the system
    action     the input u_t, (m,); one with ‖u‖ > γ is scaled down to the norm γ
    reward     ½ log(1 + hᵀ A⁻¹ h) with h = (tanh(V φ(x_{t+1}) + c), 1), the information
               that the next state adds about the weights of a linear layer on fixed
               random features of the network's inputs φ; A = λI + Σ hhᵀ over the states
               of the episode so far, λ = 1e-3. The sum of an episode is its whole gain
    terminated a component of the state is beyond the system's ``state_limit``
    truncated  after the horizon of the system (by ``gymnasium.make``)
    ========== =====================================================================

    The start is the system's ``initial_state``; the seed of ``reset`` gives the process noise.

    Parameters
    ----------
    env : System or mapping
        A system, or the section of a configuration that describes one, such as
        ``{"name": "pendulum", "gamma": 3.0}``.
    """

    def __init__(self, env: System | Mapping[str, object]) -> None:
        self.system = env if isinstance(env, System) else system_from_mapping(env)
        gamma, limit = self.system.gamma, self.system.state_limit
        self.action_space = Box(-gamma, gamma, (self.system.n_inputs,), np.float64)
        self.observation_space = Box(-limit, limit, (self.system.n_states,), np.float64)
        network, rng = MLP(width=UNITS, depth=1), np.random.default_rng(_SEED)
        parameters = network.initial_parameters(self.system, rng)
        self._weights, self._biases = network.weights(self.system, parameters)[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self._state, self._steps = np.array(self.system.initial_state), 0
        self._covariance = np.eye(UNITS + 1) / REGULARIZATION
        self._gain(self._state)
        return self._state.copy(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        system, u = self.system, np.asarray(action, dtype=np.float64)
        u = u * min(1.0, system.gamma / max(float(np.linalg.norm(u)), 1e-300))
        noise = system.noise * np.sqrt(system.dt) * self.np_random.standard_normal(system.n_states)
        following = next_state(
            system.integrator,
            lambda x: system.derivative(x, u, self._steps),
            self._state,
            system.dt,
        )
        self._state = following + noise
        self._steps += 1
        limit = system.state_limit
        terminated = not bool(np.all(np.abs(self._state) <= limit))
        observed = np.clip(np.nan_to_num(self._state, nan=limit), -limit, limit)
        return observed, self._gain(observed), terminated, False, {"input": u}

    def _gain(self, state: Array) -> float:
        """Return the information gained at a state, and take it in (Sherman and Morrison)."""
        phi = self.system.featurize(state[None])[0]
        h = np.append(np.tanh(self._weights @ phi + self._biases), 1.0)
        solved = self._covariance @ h
        added = 1.0 + float(h @ solved)
        self._covariance -= np.outer(solved, solved) / added
        return 0.5 * float(np.log(added))


def register_systems() -> None:
    """Make all shipped systems known to ``gymnasium.make``, unless they are."""
    for name, system in SYSTEMS.items():
        words = "".join(word.capitalize() for word in name.split("_"))
        identity = f"dopt/{words}-v0"
        if identity not in gymnasium.registry:
            gymnasium.register(
                identity,
                entry_point="dopt.gymnasium:Exploration",
                kwargs={"env": {"name": name}},
                max_episode_steps=system().horizon,
            )


register_systems()

__all__ = ["Environment", "Exploration", "register_systems"]
