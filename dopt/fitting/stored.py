"""A fit as the trial that a results database holds: its steps are rows of the logs.

The state of a row is as it was simulated, its loss the error of the simulation there: the root mean
square over the measured states, in standard deviations of the noise. A row on the border of two
windows is the end of the first one. Numbers of the fit are assessments (:data:`FIT_MEASURES`).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from dopt.fitting.model import data_of
from dopt.fitting.problem import Simulator
from dopt.fitting.simulation import Data
from dopt.result import Assessment, TrialResult
from dopt.spec.label import config_label
from dopt.spec.trial import FIT_MARK, MarkedTrial, marked_json
from dopt.types import Array, Integers

FIT_MEASURES = {
    "constant.NAME": "estimate of a constant, or of the delay or the lag [s]",
    "error.NAME": "its standard error",
    "noise.STATE": "standard deviation of what the model leaves, in the unit of the state",
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

    A fit of the same plant to the same logs in the same way has the same key.

    Attributes
    ----------
    config_json : str
        Canonical JSON of the marked configuration of a :class:`dopt.fitting.fitted.Fitted`.
    result : dopt.result.TrialResult
    """

    def __init__(self, found: Any) -> None:
        self.seed = 0
        rows, states, loss = _simulated(found)
        self._step = _step(found.data, rows)
        self.result = _result(found, rows, states, loss, self._step)
        model, n_steps = found.chosen.model, len(rows) - 1
        named: dict[str, object] = {"name": "constants"}
        if found.has_network:
            drawn = hashlib.sha256(model.prior.tobytes()).hexdigest()  # which stands for the seed
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
    errors = (data.measured - states[:, model.structure.measured]) / data.deviations
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
        wall_seconds=math.nan,
        cpu_seconds=math.nan,
        assessments=(*_numbers(found, n), *_errors(found, n, step)),
    )


def _numbers(found: Any, n: int) -> Iterator[Assessment]:
    values = {"useful": found.useful(), "window": found.selection.window, "weight": found.chosen.s}
    for name, (value, error) in found.constants.items():
        values |= {f"constant.{name}": value, f"error.{name}": error}
    values |= {f"noise.{name}": value for name, value in found.noise.items()}
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
