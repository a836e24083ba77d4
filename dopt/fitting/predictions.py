"""Predictions of parts of a log, and by a linear model for comparison."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dopt.fitting.problem import Simulator, Windows, first_states, windows_of
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
        """Return the mean square of each window with a measurement, in standard deviations."""
        return np.array(
            [
                float(np.mean(np.square((error / self.deviations)[np.isfinite(change)])))
                for error, change in zip(self.errors, self.changes, strict=True)
                if np.isfinite(change).any()
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


def prediction_rows(
    data: Data,
    rows: tuple[int, int],
    history: float,
    horizon: float,
    *,
    skip: float,
    ahead: float,
) -> Integers:
    """Return windows within first and last rows, (k, 3), as :func:`predicted` takes them.

    Each has a history and a horizon [s]; ``skip`` and ``ahead`` are as in
    :func:`dopt.fitting.problem.windows_of`.
    """
    windows = windows_of(data, *rows, history + horizon, skip=skip, ahead=ahead)
    out = [
        (first, first + np.searchsorted(data.time[first:last], data.time[first] + history), last)
        for first, last in windows
    ]
    return np.array(out, np.int64).reshape(-1, 3)


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


def errors_ahead(
    found: Sequence[Predicted], horizons: Sequence[float], seconds: Array, noise: Array
) -> Array:
    """Return the root mean square errors of predictions so far ahead [s], (N, n).

    They are interpolated between the horizons; at 0 they are the noise, (n,), below which they do
    not fall, and beyond the last horizon they stay.
    """
    rows = horizon_errors(found, horizons)
    times = [0.0, *(row[0].horizon for row in rows)]
    out = np.empty((len(seconds), len(noise)))
    for c, deviation in enumerate(noise):
        errors = [deviation, *(max(row[c].rms, deviation) for row in rows)]
        out[:, c] = np.interp(seconds, times, errors)
    return out


class _Rows(NamedTuple):
    """Measured rows of data, in units of their spread."""

    at: Integers  # (N,) their rows in the data
    outputs: Array  # (N, n)
    inputs: Array  # (N, m)
    late: int  # rows from an input to its effect

    def regressors(self, k: Integers) -> Array:
        """Return earlier outputs, the newest first, earlier inputs, and 1."""
        past = [self.outputs[k - 1 - i] for i in range(ORDER)]
        return np.concatenate([*past, *self.before(k), np.ones((len(k), 1))], axis=1)

    def before(self, k: Any) -> list[Array]:
        """Return the inputs that count at rows k, the newest first."""
        return [self.inputs[k - 1 - self.late - i] for i in range(ORDER)]


def linear_predictions(
    train: Data,
    data: Data,
    rows: Integers,
    delay: float,
    step: float,
    without: tuple[int, int] | None = None,
) -> Predicted:
    """Predict windows of data, (k, 3), by a linear model (ARX) that is fitted to other data.

    Its outputs depend on ``ORDER`` earlier outputs and as many inputs, from the delay on. It takes
    rows for equally spaced. ``without`` are first and last rows that it is not fitted to.
    """
    level, scale = np.nanmean(train.measured, axis=0), np.nanstd(train.measured, axis=0)
    scale, size = np.maximum(scale, 1e-300), np.maximum(np.abs(train.inputs).max(axis=0), 1e-300)
    late = max(0, round(delay / step))

    def of(each: Data) -> _Rows:
        seen = np.flatnonzero(np.isfinite(each.measured).all(axis=1))
        return _Rows(seen, (each.measured[seen] - level) / scale, each.inputs[seen] / size, late)

    known, found, depth = of(train), of(data), ORDER + late
    k = np.arange(depth, len(known.at))
    k = k[train.firsts[known.at[k]] == train.firsts[known.at[k - depth]]]
    if without is not None:
        k = k[(known.at[k] < without[0]) | (known.at[k - depth] > without[1])]
    out = Predicted([], [], [], data.deviations)
    if not len(k):
        return out
    theta = np.linalg.lstsq(known.regressors(k), known.outputs[k], rcond=None)[0]
    for begin, middle, last in rows:
        ahead = np.flatnonzero((found.at > middle) & (found.at <= last))
        before = np.flatnonzero((found.at >= begin) & (found.at <= middle))
        if len(before) < depth + 1 or not len(ahead):
            continue
        path = list(found.outputs[before[-ORDER:]][::-1])  # the newest first
        for row in ahead:
            regressors = np.concatenate([*path[:ORDER], *found.before(row), [1.0]])
            path.insert(0, np.clip(regressors @ theta, -1e9, 1e9))
        simulated = np.array(path[: len(ahead)])[::-1]
        out.seconds.append(data.time[found.at[ahead]] - data.time[middle])
        out.errors.append((found.outputs[ahead] - simulated) * scale)
        out.changes.append((found.outputs[ahead] - found.outputs[before[-1]]) * scale)
    return out
