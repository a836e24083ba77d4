"""Predictions of parts of a log, and by a linear model for comparison."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dopt.fitting.problem import Simulator, Windows, first_states
from dopt.fitting.simulation import Data
from dopt.types import Array, Integers

HORIZONS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Times ahead of which errors are reported, by the length of the windows."""

ORDER = 4
"""Earlier outputs and inputs that the linear model reads."""


class Predicted(NamedTuple):
    """Predictions of windows after a history: errors in the units of the measured states.

    Attributes
    ----------
    seconds : list of (rows,)
        Times after the history.
    errors : list of (rows, n)
        Measured less predicted; NaN where nothing was measured, inf where a simulation diverged.
    changes : list of (rows, n)
        Measured less the last measurement of the history.
    deviations : (n,)
    """

    seconds: list[Array]
    errors: list[Array]
    changes: list[Array]
    deviations: Array

    def mean_squares(self) -> Array:
        """Return the mean square of each window, in standard deviations."""
        return np.array(
            [
                float(np.mean(np.square((error / self.deviations)[np.isfinite(change)])))
                if np.isfinite(change).any()
                else math.nan
                for error, change in zip(self.errors, self.changes, strict=True)
            ]
        )

    def at(self, horizon: float) -> tuple[Array, Array]:
        """Return errors and changes, (windows, n), at the last measurement up to a time."""
        errors, changes = [], []
        for seconds, error, change in zip(self.seconds, self.errors, self.changes, strict=True):
            inside = np.flatnonzero(
                (seconds <= horizon * (1 + 1e-9)) & np.isfinite(change).all(axis=1)
            )
            if len(inside) and seconds[inside[-1]] >= 0.8 * horizon:
                errors.append(error[inside[-1]])
                changes.append(change[inside[-1]])
        n = len(self.deviations)
        return np.array(errors).reshape(-1, n), np.array(changes).reshape(-1, n)


def predicted(simulator: Simulator, p: Array, rows: Integers) -> Predicted:
    """Predict windows, (k, 3): first row, last row of the history, last row."""
    data, model = simulator.data, simulator.model
    history = np.ascontiguousarray(rows[:, :2])
    windows = Windows(history, first_states(data, model, history))
    windows = simulator.settled(p, windows) if len(rows) else windows
    seconds, errors, changes = [], [], []
    measured = model.structure.measured
    for (first, middle, last), start in zip(rows, windows.starts, strict=True):
        states = simulator.states(p, first, last, start)[middle + 1 - first :, measured]
        seen = data.measured[middle + 1 : last + 1]
        before = data.measured[first : middle + 1]
        newest = [column[np.isfinite(column)][-1:] for column in before.T]
        reference = np.array([value[0] if len(value) else math.nan for value in newest])
        error = seen - states
        error[np.isnan(states)] = np.inf
        seconds.append(data.time[middle + 1 : last + 1] - data.time[middle])
        errors.append(error)
        changes.append(seen - reference)
    return Predicted(seconds, errors, changes, data.deviations)


class HorizonError(NamedTuple):
    """Error of predictions so far ahead, over several windows, for one measured state."""

    horizon: float  # [s]
    rms: float
    median: float
    nothing_changes: float  # root mean square of the changes
    windows: int


def horizon_errors(
    found: Sequence[Predicted], horizons: Sequence[float]
) -> list[list[HorizonError]]:
    """Return the errors at each horizon of each measured state; none where no window is so long."""
    out = []
    for horizon in horizons:
        both = [each.at(horizon) for each in found]
        errors = np.concatenate([error for error, _ in both])
        changes = np.concatenate([change for _, change in both])
        if not len(errors):
            continue
        row = []
        for error, change in zip(errors.T, changes.T, strict=True):
            rms = float(np.sqrt(np.mean(np.square(error))))
            moved = float(np.sqrt(np.mean(np.square(change))))
            row.append(
                HorizonError(horizon, rms, float(np.median(np.abs(error))), moved, len(error))
            )
        out.append(row)
    return out


def linear_predictions(
    data: Data, block: tuple[int, int], rows: Integers, delay: float, step: float
) -> Predicted:
    """Predict windows, (k, 3), by a linear model (ARX) that was fitted to the other rows.

    Its outputs depend on ``ORDER`` earlier outputs and as many inputs, from the delay on. It takes rows
    for equally spaced.
    """
    seen = np.flatnonzero(np.isfinite(data.measured).all(axis=1))
    y, u, first = data.measured[seen], data.inputs[seen], data.firsts[seen]
    late = max(0, round(delay / step))
    depth = ORDER + late
    at = np.arange(depth, len(seen))
    at = at[first[at] == first[at - depth]]
    other = (seen[at] < block[0]) | (seen[at - depth] > block[1])
    seconds, errors, changes = [], [], []
    if not other.any():
        return Predicted(seconds, errors, changes, data.deviations)
    scale, level = np.maximum(y.std(axis=0), 1e-300), y.mean(axis=0)
    size = np.maximum(np.abs(u).max(axis=0), 1e-300)
    z, v = (y - level) / scale, u / size

    def regressors(k: Array) -> Array:
        past = [z[k - 1 - i] for i in range(ORDER)] + [v[k - 1 - late - i] for i in range(ORDER)]
        return np.concatenate([*past, np.ones((len(k), 1))], axis=1)

    used = at[other]
    theta = np.linalg.lstsq(regressors(used), z[used], rcond=None)[0]
    for begin, middle, last in rows:
        ahead = np.flatnonzero((seen > middle) & (seen <= last))
        before = np.flatnonzero((seen >= begin) & (seen <= middle))
        if len(before) < depth + 1 or not len(ahead):
            continue
        real = z[ahead].copy()
        path = list(z[before[-ORDER:]][::-1])  # the newest first
        for k in ahead:
            past = [v[k - 1 - late - i] for i in range(ORDER)]
            path.insert(0, np.concatenate([*path[:ORDER], *past, [1.0]]) @ theta)
        predicted_ = np.clip(np.array(path[: len(ahead)])[::-1], -1e9, 1e9)
        seconds.append(data.time[seen[ahead]] - data.time[middle])
        errors.append((real - predicted_) * scale)
        changes.append((real - z[before[-1]]) * scale)
    return Predicted(seconds, errors, changes, data.deviations)
