"""A fitted plant outside the package: arrays in a file, a module of PyTorch, an environment."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from dopt.errors import SpecificationError
from dopt.fitting.model import Model
from dopt.types import Array


def save(found: Any, path: str | Path) -> None:
    """Write a model as named arrays: texts of the known part, constants, network, delay and lag.

    ``docs/example/load_model.py`` reads it with NumPy alone.
    """
    model, p = found.chosen.model, found.chosen.solution.p
    values, s, plant = model.values(p), model.structure, found.plant
    W1, b1, W2, b2 = model.matrices(values.weights)
    np.savez(
        Path(path).with_suffix(".npz"),
        states=np.array([*plant.states]),
        inputs=np.array([*plant.inputs]),
        known=np.array([plant.known.get(name, "0.0") for name in plant.states]),
        constant_names=np.array([*plant.constants], dtype=str),
        constants=values.constants,
        learned=s.learned,
        feature_kinds=s.feature_kinds,
        feature_indices=s.feature_indices,
        feature_centers=s.feature_centers,
        feature_scales=s.feature_scales,
        W1=W1,
        b1=b1,
        W2=W2,
        b2=b2,
        sizes=values.sizes,
        delay=values.delay,
        lag=values.lag,
        dt=plant.dt,
        supply=plant.supply,
        plant=json.dumps(plant.to_section()),
        report=found.report(),
    )


def to_torch(found: Any) -> Any:
    """Return a module that gives dx/dt, (..., d), at x, (..., d), and u, (..., m), which acts."""
    import torch

    model, p = found.chosen.model, found.chosen.solution.p
    values, s = model.values(p), model.structure
    w, n, r = model.width, len(s.feature_kinds), len(s.learned)

    class FittedDynamics(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.constants = torch.nn.Parameter(torch.tensor(values.constants))
            first = torch.nn.Linear(n, w, dtype=torch.float64)
            last = torch.nn.Linear(w, r, dtype=torch.float64)
            with torch.no_grad():
                tensors = (first.weight, first.bias, last.weight, last.bias)
                for tensor, part in zip(tensors, model.matrices(values.weights), strict=True):
                    tensor.copy_(torch.tensor(part))
            self.network = torch.nn.Sequential(first, torch.nn.Tanh(), last) if w else None
            self.register_buffer("sizes", torch.tensor(values.sizes))
            self.register_buffer("centers", torch.tensor(s.feature_centers))
            self.register_buffer("scales", torch.tensor(s.feature_scales))

        def forward(self, x: Any, u: Any) -> Any:
            x, u = x.to(self.constants.dtype), u.to(self.constants.dtype)
            given = (x.unbind(-1), u.unbind(-1), self.constants.unbind(-1))
            zero = torch.zeros_like(x[..., 0])
            flow = torch.stack([zero + part for part in model.equation(*given)], dim=-1)
            if self.network is None:
                return flow
            at = x[..., torch.as_tensor(s.feature_indices)]
            kinds = torch.as_tensor(s.feature_kinds)
            phi = (at - self.centers) / self.scales
            phi = torch.where(
                kinds == 1, torch.cos(at), torch.where(kinds == 2, torch.sin(at), phi)
            )
            added = torch.zeros_like(flow)
            added[..., torch.as_tensor(s.learned)] = self.network(phi) * self.sizes
            return flow + added

    return FittedDynamics()


def environment(found: Any) -> Any:
    """Return the fitted plant as an environment of Gymnasium.

    The observation is the state, the action the input that is asked for, which is cut to the
    supply and acts after the delay through the lag. A step takes ``plant.dt``, by the method of
    Runge and Kutta. The reward is 0: subclasses or wrappers have a task.
    """
    try:
        import gymnasium
    except ModuleNotFoundError as error:
        raise SpecificationError(
            "environment() needs the library gymnasium, which is not installed: install it with "
            "pip install gymnasium."
        ) from error

    model, p = found.chosen.model, found.chosen.solution.p
    values, plant = model.values(p), found.plant
    starts = found.chosen.solution.windows.starts
    bound = min(plant.gamma, plant.supply)

    class FittedPlant(gymnasium.Env):  # type: ignore[misc]  # of a library that may lack
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (model.d,), np.float64)
        action_space = gymnasium.spaces.Box(-bound, bound, (model.m,), np.float64)

        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[Array, dict[str, Any]]:
            super().reset(seed=seed)
            given = (options or {}).get("state")
            drawn = starts[self.np_random.integers(len(starts))]
            self.state = np.array(drawn if given is None else given, float)
            kept = math.ceil(max(values.delay, 0.0) / plant.dt - 1e-9) + 1
            self._asked = [np.zeros(model.m)] * kept
            self._acting = np.zeros(model.m)
            return self.state.copy(), {}

        def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
            u = np.clip(np.asarray(action, float).reshape(model.m), -plant.supply, plant.supply)
            self._asked = [u, *self._asked[:-1]]
            for seconds, row in acting(max(values.delay, 0.0), plant.dt):
                self.state, self._acting = advance(
                    model, p, values.lag, self.state, self._acting, self._asked[row], seconds
                )
            inside = bool(np.all(np.abs(self.state) <= model.structure.limits))
            return self.state.copy(), 0.0, not inside, False, {}

    return FittedPlant()


def acting(delay: float, dt: float) -> list[tuple[float, int]]:
    """Return for how long [s] the input of how many steps before acts in a step, in their order."""
    whole = math.floor(delay / dt + 1e-9)
    part = max(delay - whole * dt, 0.0)
    if part < 1e-9 * dt:
        return [(dt, whole)]
    return [(part, whole + 1), (dt - part, whole)]


def advance(
    model: Model, p: Array, lag: float, x: Array, v: Array, u: Array, seconds: float
) -> tuple[Array, Array]:
    """Return the state and what acts after a time under an input that is held."""

    def acts(s: float) -> Array:
        reached: Array = u if lag <= 0.0 else u + (v - u) * math.exp(-s / lag)
        return reached

    def rate(state: Array, s: float) -> Array:
        flow: Array = model.derivative(p, state[None], acts(s)[None])[0]
        return flow

    steps = max(1, math.ceil(seconds / model.structure.longest_step - 1e-9))
    h = seconds / steps
    for i in range(steps):
        k1 = rate(x, i * h)
        k2 = rate(x + 0.5 * h * k1, (i + 0.5) * h)
        k3 = rate(x + 0.5 * h * k2, (i + 0.5) * h)
        k4 = rate(x + h * k3, (i + 1) * h)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return x, acts(seconds)
