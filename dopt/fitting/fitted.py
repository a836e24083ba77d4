"""What a fit has found: constants with errors, simulations with intervals, and a report."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError
from dopt.fitting.model import Model, data_of, measured_names
from dopt.fitting.problem import Simulator, Solution, Windows, first_states, windows_of
from dopt.fitting.simulation import Data
from dopt.log import Log
from dopt.systems.plant import Plant
from dopt.types import Array, Integers


class Estimate(NamedTuple):
    """A minimum with the covariance of its parameters."""

    model: Model
    solution: Solution
    s: float
    covariance: Array  # (q, q)


class Selection(NamedTuple):
    """What validation over blocks has compared: losses with standard errors, and notes."""

    table: tuple[tuple[str, float, float], ...]
    window: float  # length that was chosen [s]
    delays: dict[float, float]  # delay [s]: residual of short windows in first deviations
    notes: tuple[str, ...]


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


class Simulation(NamedTuple):
    """A simulation of one piece of a log.

    Attributes
    ----------
    time : (N,)
        [s]
    states : (N, d)
    lower, upper : (N, n)
        Bounds of what is measured, at the level that was asked for.
    """

    time: Array
    states: Array
    lower: Array
    upper: Array


class Fitted:
    """A plant fitted to logs (:func:`dopt.fit`).

    Attributes
    ----------
    constants : dict of str to (float, float)
        Estimate and standard error of each unknown constant, of ``delay`` and ``lag`` [s]; from the
        fit without a network.
    has_network : bool
        Whether validation wanted one.
    """

    def __init__(
        self,
        plant: Plant,
        hold: str,
        data: Data,
        chosen: Estimate,
        physics: Estimate,
        held_out: Sequence[Predicted],
        selection: Selection,
        tests: Sequence[Log],
    ) -> None:
        self.plant, self.hold, self.selection, self.tests = plant, hold, selection, list(tests)
        self._data, self._chosen, self._physics = data, chosen, physics
        self._held_out = list(held_out)
        self.has_network = chosen is not physics

    @functools.cached_property
    def constants(self) -> dict[str, tuple[float, float]]:
        model, solution, _, covariance = self._physics
        values, slopes = model.named_values(solution.p)
        deviations = np.abs(slopes) * np.sqrt(np.diag(covariance)[model.named])
        return {
            name: (value, float(error))
            for (name, value), error in zip(values.items(), deviations, strict=True)
        }

    @property
    def delay(self) -> float:
        """Time from an input to its effect in the chosen model [s]."""
        return float(self._chosen.model.values(self._chosen.solution.p).delay)

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of what the model leaves of each measured state, in its unit."""
        names = measured_names(self.plant)
        return dict(zip(names, map(float, self._data.deviations), strict=True))

    def predict(self, states: npt.ArrayLike, inputs: npt.ArrayLike) -> Array:
        """Return dx/dt, (N, d), at states, (N, d), under inputs that act there, (N, m)."""
        x = np.atleast_2d(np.asarray(states, float))
        u = np.atleast_2d(np.asarray(inputs, float))
        d, m = self._chosen.model.d, self._chosen.model.m
        if x.ndim != 2 or x.shape[1] != d or u.shape != (len(x), m):
            raise SpecificationError(
                f"states of shape {x.shape} and inputs of shape {u.shape} were given, but (N, {d}) "
                f"and (N, {m}) are expected: correct them."
            )
        return self._chosen.model.derivative(self._chosen.solution.p, x, u)

    def simulate(
        self, run: Any, *, history: float | None = None, level: float = 0.9
    ) -> list[Simulation]:
        """Simulate the pieces of a log, each from a state that is fitted to its beginning.

        Parameters
        ----------
        run : Log, DataFrame or mapping
        history : float, optional
            Seconds of the beginning to which the initial state is fitted; half a window by default.
        level : float
            Share of measurements that the bounds are to hold: of the uncertainty of the parameters
            and of the initial state, and of the noise.

        Raises
        ------
        SpecificationError
            If the log does not fit the plant, or no piece of it is longer than the history.
        """
        from scipy.stats import norm

        if not 0 < level < 1:
            raise SpecificationError(
                f"level is {level!r}, but a share between 0 and 1 is expected: give for instance 0.9."
            )
        data, z = self._with(run), float(norm.ppf(0.5 + 0.5 * level))
        model, solution, s, covariance = self._chosen
        simulator = Simulator(model, data)
        seconds = 0.5 * self.selection.window if history is None else float(history)
        out = []
        for rows in self._whole(data, seconds):
            first, middle, last = rows
            window = Windows(np.array([[first, middle]]), first_states(data, model, rows[None, :2]))
            window = simulator.settled(solution.p, window)
            states, S = simulator.slopes(solution.p, first, last, window.starts[0])
            linear = simulator.linear(solution.p, window, np.ones(1))
            inverse = np.linalg.pinv(linear.T[0])
            measured = model.structure.measured
            by_start = S[:, measured, model.q :] @ inverse
            by_p = S[:, measured, : model.q] - by_start @ linear.C[0]
            variance = np.einsum("tnq,qr,tnr->tn", by_p, covariance, by_p)
            variance += np.square(by_start).sum(axis=2) + np.square(data.deviations)
            half, seen = (
                z * np.sqrt(variance),
                np.isfinite(data.measured[first : last + 1]).any(axis=1),
            )
            seen |= self.hold == "zero"
            middle_states = states[:, measured]
            out.append(
                Simulation(
                    data.time[first : last + 1][seen],
                    states[seen],
                    (middle_states - half)[seen],
                    (middle_states + half)[seen],
                )
            )
        return out

    def _with(self, run: Any) -> Data:
        log = run if isinstance(run, Log) else Log.for_plant(run, self.plant)
        return data_of(self.plant, [log], self.hold, self._data.deviations)

    def _whole(self, data: Data, history: float) -> Integers:
        """Return first row, last row of the history and last row of the pieces of data."""
        out = []
        for first in np.unique(data.firsts):
            last, begin = int(data.lasts[first]), int(first)
            while begin < last and data.time[begin] - data.time[first] < self._latest(data):
                begin += 1
            middle = begin + int(
                np.searchsorted(data.time[begin : last + 1], data.time[begin] + history)
            )
            if middle < last:
                out.append((begin, middle, last))
        if not out:
            raise SpecificationError(
                f"no piece of the log is longer than its first {history:g} s, to which the initial "
                f"state is fitted: give a longer log, or a shorter history."
            )
        return np.array(out, np.int64)

    def _latest(self, data: Data) -> float:
        values = self._chosen.model.values(self._chosen.solution.p)
        return max(values.delay, 0.0) + 3.0 * values.lag

    def free_run_error(self, run: Any, *, history: float | None = None) -> dict[str, float]:
        """Return the root mean square error of :meth:`simulate` after the history, by state."""
        data = self._with(run)
        seconds = 0.5 * self.selection.window if history is None else float(history)
        rows = self._whole(data, seconds)
        found = predicted(Simulator(self._chosen.model, data), self._chosen.solution.p, rows)
        errors = np.concatenate(found.errors)
        squares = [np.mean(np.square(column[~np.isnan(column)])) for column in errors.T]
        names = measured_names(self.plant)
        return {name: float(np.sqrt(each)) for name, each in zip(names, squares, strict=True)}
