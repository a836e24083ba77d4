"""The systems of this package as Gymnasium environments."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from dopt.models import MLP
from dopt.systems import SYSTEMS, System, system_from_mapping
from dopt.systems.integration import next_state

Array = npt.NDArray[np.float64]

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
        n_features = len(self.system.features)
        sizes = (UNITS, n_features + 1)
        self._layer = MLP(width=UNITS, depth=1).initial_parameters(
            self.system, np.random.default_rng(_SEED)
        )[: sizes[0] * sizes[1]]

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
        rate = functools.partial(self._flow, u=u)
        self._state = next_state(system.integrator, rate, self._state, system.dt) + noise
        self._steps += 1
        limit = system.state_limit
        terminated = not bool(np.all(np.abs(self._state) <= limit))
        observed = np.clip(np.nan_to_num(self._state, nan=limit), -limit, limit)
        return observed, self._gain(observed), terminated, False, {"input": u}

    def _flow(self, x: Array, u: Array) -> Array:
        """Return f(x, u), (d,), of the system as it is at step t."""
        return self.system.derivative(x, u, self._steps)

    def _gain(self, state: Array) -> float:
        """Return the information gained at a state, and take it in (Sherman and Morrison)."""
        phi = self.system.featurize(state[None])[0]
        weights = self._layer[: UNITS * len(phi)].reshape(UNITS, len(phi))
        h = np.append(np.tanh(weights @ phi + self._layer[UNITS * len(phi) :]), 1.0)
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
                entry_point="dopt.gymnasium.exploration:Exploration",
                kwargs={"env": {"name": name}},
                max_episode_steps=system().horizon,
            )
