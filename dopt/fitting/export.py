"""A fitted plant outside the package: arrays in a file, a PyTorch module, an environment, a row.

As the trial that a results database holds, its steps are rows of the logs: the state is as it was
simulated, its loss the error of the simulation there, the root mean square over the measured
states, in standard deviations of the noise. A row on the border of two windows is the end of the
first one. Numbers of the fit are assessments (:data:`FIT_MEASURES`).
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dopt.errors import SpecificationError
from dopt.fitting.model import data_of
from dopt.fitting.problem import Simulator
from dopt.fitting.simulation import Data
from dopt.result import Assessment, TrialResult
from dopt.spec.config import config_label
from dopt.spec.trial import FIT_MARK, MarkedTrial, marked_json
from dopt.types import Array, Integers

SETTLED = 40.0
"""Time constants of the lag after which nothing is left of an earlier input in a double."""


def save(found: Any, path: str | Path) -> None:
    """Write a model as named arrays: texts of the known part, constants, network, delay and lag.

    ``docs/example/load_model.py`` reads it with NumPy alone.
    """
    model, p = found.chosen.model, found.chosen.solution.p
    values, s, plant = model.values(p), model.structure, found.plant
    W1, b1, W2, b2 = model.matrices(values.weights)
    np.savez(
        path,  # to which ".npz" is added where it is missing
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
            self.network = None
            if w:
                first = torch.nn.Linear(n, w, dtype=torch.float64)
                last = torch.nn.Linear(w, r, dtype=torch.float64)
                self.network = torch.nn.Sequential(first, torch.nn.Tanh(), last)
                with torch.no_grad():
                    tensors = self.network.parameters()
                    for tensor, part in zip(tensors, model.matrices(values.weights), strict=True):
                        tensor.copy_(torch.tensor(part))
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

    plant, p, model = found.plant, found.chosen.solution.p, copy.copy(found.chosen.model)
    values, starts = model.values(p), found.chosen.solution.windows.starts
    limits, bound = model.structure.limits, min(plant.gamma, plant.supply)
    model.structure = model.structure._replace(limits=np.full(model.d, np.inf))
    n = math.ceil((max(values.delay, 0.0) + SETTLED * values.lag) / plant.dt - 1e-9) + 2
    rows, nothing = np.arange(n), np.full((n, len(found.data.deviations)), np.nan)

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
            self._asked = [np.zeros(model.m)] * (n - 1)  # the newest first
            return self.state.copy(), {}

        def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
            u = np.clip(np.asarray(action, float).reshape(model.m), -plant.supply, plant.supply)
            self._asked = [u, *self._asked[:-1]]
            inputs, ends = np.array([*self._asked[::-1], u]), (0 * rows, rows[-1] + 0 * rows)
            data = Data(plant.dt * rows, nothing, inputs, *ends, found.data.deviations)
            self.state = Simulator(model, data).states(p, n - 2, n - 1, self.state)[-1]
            inside = bool(np.all(np.abs(self.state) <= limits))
            return self.state.copy(), 0.0, not inside, False, {}

    return FittedPlant()


FIT_MEASURES = {
    "constant.NAME": "estimate of a constant, or of the delay or the lag [s]",
    "error.NAME": "its standard error",
    "noise.STATE": "standard deviation of what the model leaves, in the unit of the state",
    "outliers.STATE": "measurements that were left out as outliers",
    "coverage.STATE": "share of held-out measurements within bounds of 90 %",
    "residual.STATE": "correlation of the residuals with the row before",
    "input.STATE": "their largest correlation with an earlier input",
    "rms.STATE": "root mean square error of predictions t rows ahead, in the unit of the state",
    "median.STATE": "its median",
    "physics.STATE": "the root mean square error of the constants alone",
    "linear.STATE": "the same of a linear model",
    "unchanged.STATE": "the same if nothing changes",
    "useful": "longest time ahead for which the model is worth using [s]; 0 for none",
    "window": "length of the windows [s]",
    "weight": "s, by which the residuals count as larger than the noise",
}
"""Measures of a fit; t is the number of its rows, or how many rows ahead a prediction was."""

_BY_MODEL = {"model": "rms", "physics alone": "physics", "linear": "linear"}


class FittedTrial(MarkedTrial):
    """A fit as a trial, by its plant, its logs and what was tried.

    A fit of the same plant to the same logs in the same way has the same key. Its seed is its
    network's, 0 without one.

    Attributes
    ----------
    config_json : str
        Canonical JSON of the marked configuration of a :class:`dopt.fitting.fitted.Fitted`.
    result : dopt.result.TrialResult
    """

    def __init__(self, found: Any) -> None:
        self.seed = found.selection.seed if found.has_network else 0
        rows, states, loss = _simulated(found)
        self._step = _step(found.data, rows)
        self.result = _result(found, rows, states, loss, self._step)
        model, n_steps = found.chosen.model, len(rows) - 1
        named: dict[str, object] = {"name": "constants"}
        if found.has_network:
            drawn = hashlib.sha256(model.prior.tobytes()).hexdigest()
            named = {"name": "network", "width": model.width, "start": drawn}
        tests = data_of(found.plant, found.tests, found.hold) if found.tests else None
        self._content = {
            "env": {**found.plant.system(n_steps).to_section(), **FIT_MARK},
            "policy": {"name": "recorded"},
            "model": named,
            "learner": {
                "name": "simulation_error",
                "hold": found.hold,
                "window": found.selection.window,
                "tried": [what for what, _, _ in found.selection.table],
            },
            "logs": {"fitted": digest(found.data), "validation": tests and digest(tests)},
        }
        self.config_json = marked_json(self._content)
        self._columns = {
            "width": model.width or None,
            "depth": 1 if model.width else None,
            "horizon": n_steps,
            "dt": self._step,
            "gamma": float(found.plant.gamma),
        }

    def columns(self) -> dict[str, str | int | float | None]:
        """Return what a table of configurations shows in columns of its own."""
        content = json.loads(self.config_json)
        names = {key: content[key]["name"] for key in ("env", "policy", "model", "learner")}
        return {**names, **self._columns, "label": config_label(content)}


def digest(data: Data) -> str:
    """Return the SHA-256 of the rows of logs: their times, measurements and inputs."""
    found = hashlib.sha256()
    for part in (data.time, data.measured, data.inputs, data.firsts):
        found.update(np.ascontiguousarray(part).tobytes())
    return found.hexdigest()


def _simulated(found: Any) -> tuple[Integers, Array, Array]:
    """Return the fitted rows, (T + 1,), their states, (T + 1, d), and errors, (T + 1,)."""
    data, (model, solution, _, _) = found.data, found.chosen
    simulator, states = Simulator(model, data), np.full((len(data.time), model.d), np.nan)
    for (first, last), start in zip(*solution.windows, strict=True):
        part = states[first : last + 1]
        new = np.isnan(part).all(axis=1)
        part[new] = simulator.states(solution.p, first, last, start)[new]
    errors = data.measured - states[:, model.structure.measured]
    errors /= np.array([*found.noise.values()])
    rows = np.flatnonzero(np.isfinite(errors).any(axis=1) & np.isfinite(states).all(axis=1))
    return rows, states[rows], np.sqrt(np.nanmean(np.square(errors[rows]), axis=1))


def _step(data: Data, rows: Integers) -> float:
    """Return the median time between two rows [s]."""
    steps = np.diff(data.time[rows])[np.diff(data.firsts[rows]) == 0]
    return float(f"{np.median(steps):.9g}")


def _result(found: Any, rows: Integers, states: Array, loss: Array, step: float) -> TrialResult:
    n = len(rows) - 1
    unknown = np.full(n, np.nan)
    return TrialResult(
        loss=loss[1:],
        reachable_loss=unknown,
        plan_us=unknown,
        learn_us=unknown,
        evaluate_us=unknown,
        states=states,
        inputs=found.data.inputs[rows[:-1]],
        parameters=found.chosen.solution.p,
        diverged_at=None,
        wall_seconds=found.selection.seconds,
        cpu_seconds=math.nan,
        assessments=(*_numbers(found, n), *_errors(found, n, step)),
    )


def _numbers(found: Any, n: int) -> Iterator[Assessment]:
    values = {"useful": found.useful(), "window": found.selection.window, "weight": found.chosen.s}
    for name, (value, error) in found.constants.items():
        values |= {f"constant.{name}": value, f"error.{name}": error}
    values |= {f"noise.{name}": value for name, value in found.noise.items()}
    values |= {f"outliers.{name}": float(count) for name, count in found.selection.outliers.items()}
    values |= {f"coverage.{name}": share for name, share in found.coverage().items()}
    for name, (own, other) in found.whiteness().items():
        values |= {f"residual.{name}": own, f"input.{name}": other}
    for name, value in values.items():
        yield Assessment(n, name, value)


def _errors(found: Any, n: int, step: float) -> Iterator[Assessment]:
    """Yield errors of predictions; horizons beyond the rows of the fit are left out."""
    values: dict[tuple[int, str], float] = {}
    for row in found.errors():
        t, state = max(1, round(row["horizon"] / step)), row["state"]
        values[t, f"{_BY_MODEL[row['model']]}.{state}"] = row["rms"]
        if row["model"] == "model":
            values[t, f"median.{state}"] = row["median"]
            values[t, f"unchanged.{state}"] = row["nothing_changes"]
    for (t, name), value in values.items():
        if t <= n:
            yield Assessment(t, name, value)
