"""Result of a fit: constants with errors, simulations with bounds, and a report."""

from __future__ import annotations

import functools
import itertools
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from dopt.errors import SpecificationError, counted
from dopt.fitting import export
from dopt.fitting.model import Model, data_of, measured_names
from dopt.fitting.problem import (
    FEWEST,
    HORIZONS,
    Predicted,
    Simulator,
    Solution,
    Windows,
    errors_ahead,
    fast_noise,
    first_states,
    horizon_errors,
    left_over,
    linear_predictions,
    predicted,
    prediction_rows,
)
from dopt.fitting.simulation import Data
from dopt.log import Log
from dopt.systems.plant import Plant, Unknown
from dopt.types import Array, Integers

USEFUL = 0.5
"""Largest error of a model that is worth using, by the changes themselves."""

MOVING = 5.0
"""Changes, by the noise, beside which a model can be judged."""

CORRELATED = 0.7
"""Correlation of residuals with the row before from which the equations lack something."""

DIVERGED = 1e300
"""Error of a prediction that diverges, by the one that is expected."""

DRAWN = 100
"""Parameters, with initial states, that bounds are drawn from: an angle may turn either way."""

TOLD_APART = 0.1
"""Largest standard error of delay and lag that are told apart, by their sizes together."""


class Estimate(NamedTuple):
    """A minimum with the covariance of its parameters."""

    model: Model
    solution: Solution
    s: float
    covariance: Array  # (q, q)


class Selection(NamedTuple):
    """Comparisons by validation over blocks: losses with standard errors, settings and notes."""

    table: tuple[tuple[str, float, float], ...]
    window: float  # length that was chosen [s]
    notes: tuple[str, ...]
    outliers: Mapping[str, int]  # measurements that were left out, by state
    seed: int  # of the network that was tried
    seconds: float  # wall time of the fit [s]


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
        Estimate and standard error of each unknown constant, in the unit of the plant, of ``delay``
        and ``lag`` [s]; from the fit without a network. ``Explorer.constants`` has no errors.
    has_network : bool
        Whether validation wanted one.
    chosen, physics : Estimate
        What was chosen, and the fit of the constants without a network; the same if it was refused.
    data : Data
        Rows of all logs, and the standard deviations by which they were weighed.
    """

    def __init__(
        self,
        plant: Plant,
        hold: str,
        data: Data,
        chosen: Estimate,
        physics: Estimate,
        held_out: Mapping[str, list[Predicted]],
        selection: Selection,
        tests: Sequence[Log],
    ) -> None:
        self.plant, self.hold, self.selection, self.tests = plant, hold, selection, list(tests)
        self.data, self.chosen, self.physics = data, chosen, physics
        self._deviations = left_over(data, chosen.model, chosen.solution)
        self._held_out = dict(held_out)
        self.has_network = chosen is not physics
        if {"delay", "lag"} <= {*physics.model.names[physics.model.n_named :]}:
            note = self._delay_and_lag()
            self.selection = selection._replace(notes=(*selection.notes, note))

    @functools.cached_property
    def constants(self) -> dict[str, tuple[float, float]]:
        return self.physics.model.with_errors(self.physics.solution.p, self.physics.covariance)

    def _delay_and_lag(self) -> str:
        """Return in a sentence whether the data tell the delay from the lag.

        Their errors decide: their correlation is near -1 also where both are known well.
        """
        model, solution, _, covariance = self.physics
        last = model.named[-2:]
        (delay, lag), slopes = (
            [*part][-2:] for part in (self.constants.values(), model.named_values(solution.p)[1])
        )
        C = covariance[np.ix_(last, last)] * np.outer(slopes, slopes)
        rho = C[0, 1] / max(math.sqrt(C[0, 0] * C[1, 1]), 1e-300)
        both = f"(correlation {rho:.3f})"
        if max(delay[1], lag[1]) <= TOLD_APART * (abs(delay[0]) + abs(lag[0])):
            return f"the logs tell the delay and the lag apart {both}"
        return (
            f"the logs do not tell the delay and the lag apart {both}: what they give is the sum, "
            f"{delay[0] + lag[0]:.4g} ± {math.sqrt(max(C.sum(), 0.0)):.2g} s; declare one of both"
        )

    @property
    def given(self) -> dict[str, float]:
        """Constants that were not fitted, and the delay and the lag where they were given."""
        times, known = {"delay": self.plant.delay, "lag": self.plant.lag}, {**self.plant.constants}
        known |= {name: v for name, v in times.items() if v and name not in known}
        return {name: float(v) for name, v in known.items() if not isinstance(v, Unknown)}

    @property
    def delay(self) -> float:
        """Time from an input to its effect in the chosen model [s]."""
        return float(self.chosen.model.values(self.chosen.solution.p).delay)

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of what the model leaves of each measured state, in its unit."""
        names = measured_names(self.plant)
        return dict(zip(names, map(float, self._deviations), strict=True))

    def predict(self, states: npt.ArrayLike, inputs: npt.ArrayLike) -> Array:
        """Return dx/dt, (N, d), at states, (N, d), under inputs that act there, (N, m)."""
        x = np.atleast_2d(np.asarray(states, float))
        u = np.atleast_2d(np.asarray(inputs, float))
        d, m = self.chosen.model.d, self.chosen.model.m
        if x.ndim != 2 or x.shape[1] != d or u.shape != (len(x), m):
            raise SpecificationError(
                f"states of shape {x.shape} and inputs of shape {u.shape} were given, but (N, {d}) "
                f"and (N, {m}) are expected: correct them."
            )
        return self.chosen.model.derivative(self.chosen.solution.p, x, u)

    def simulate(
        self, run: Any, *, history: float | None = None, level: float = 0.9
    ) -> list[Simulation]:
        """Simulate the pieces of a log, each from a state that is fitted to its beginning.

        Pieces that are not longer than the history are left out, and so are the first rows of a
        piece, on which inputs before the log act: rows are matched by their ``time``.

        Parameters
        ----------
        run : Log, DataFrame or mapping
        history : float, optional
            Seconds of the beginning to which the initial state is fitted; half a window by default.
        level : float
            Share of measurements that the bounds are to hold: of simulations with other likely
            parameters and initial states, and of the errors of held-out predictions, widened until
            they hold as many of these.

        Raises
        ------
        SpecificationError
            If the log does not fit the plant, or no piece of it is longer than the history.
        """
        if not 0 < level < 1:
            raise SpecificationError(
                f"level is {level!r}, but a share between 0 and 1 is expected: give for instance "
                f"0.9."
            )
        log = run if isinstance(run, Log) else Log.for_plant(run, self.plant)
        data = data_of(self.plant, [log], self.hold, self._deviations)
        z = float(ndtri(0.5 + 0.5 * level))
        model, solution, _, covariance = self.chosen
        simulator, measured = Simulator(model, data), model.structure.measured
        rng, out = np.random.default_rng(self.selection.seed), []
        values, vectors = np.linalg.eigh(covariance)
        drawn = rng.standard_normal((DRAWN, model.q)) * np.sqrt(np.maximum(values, 0.0))
        changes, others = drawn @ vectors.T, rng.standard_normal((DRAWN, model.d))
        for first, middle, last in self._whole(data, history):
            rows = np.array([[first, middle]])
            window = Windows(rows, first_states(data, model, rows))
            window = simulator.settled(solution.p, window)
            start, linear = window.starts[0], simulator.linear(solution.p, window, np.ones(1))
            states = simulator.states(solution.p, first, last, start)
            inverse, C = np.linalg.pinv(linear.T[0]), linear.C[0]
            likely = [
                simulator.states(solution.p + step, first, last, start + inverse @ (own - C @ step))
                for step, own in zip(changes, others, strict=True)
            ]
            noise = self._widening(level) * z
            noise = noise * self.errors_ahead(data.time[first : last + 1] - data.time[middle])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of rows that none has reached
                ends = np.nanquantile(likely, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
            centre = states[:, measured]
            low, high = (
                centre + side * np.hypot(np.maximum(side * (end[:, measured] - centre), 0.0), noise)
                for side, end in zip((-1, 1), ends, strict=True)
            )
            recorded = np.isfinite(data.measured[first : last + 1]).any(axis=1)
            recorded |= self.hold == "zero"  # a linear hold adds rows
            parts = (data.time[first : last + 1], states, low, high)
            out.append(Simulation(*(part[recorded] for part in parts)))
        return out

    def errors_ahead(self, seconds: Array) -> Array:
        """Return the root mean square errors of held-out predictions so far ahead, (N, n).

        Before the first horizon they are the noise, and beyond the last one they may grow on.
        """
        return errors_ahead(self._held_out["model"], self.horizons, seconds, self._deviations)

    @property
    def horizons(self) -> list[float]:
        """Times ahead of which the report has errors [s]."""
        return [share * self.selection.window for share in HORIZONS]

    def errors(self) -> list[dict[str, Any]]:
        """Return the errors of predictions, one row for each horizon, state and model.

        They are taken on the runs for validation, or on held-out blocks without such runs.
        """
        found = self._tested if self.tests else self._held_out
        names = measured_names(self.plant)
        return [
            {"state": name, "model": what, **error._asdict()}
            for what, predictions in found.items()
            for row in horizon_errors(predictions, self.horizons)
            for name, error in zip(names, row, strict=True)
        ]

    @functools.cached_property
    def _tested(self) -> dict[str, list[Predicted]]:
        data = data_of(self.plant, self.tests, self.hold, self._deviations)
        history, skip, ahead = 0.5 * self.selection.window, self._latest(), 2.0 * self.plant.dt
        longest = float((data.time[data.lasts] - data.time[data.firsts]).max())
        left = longest - history - skip - ahead - 2.0 * self.plant.dt
        for horizon in reversed(self.horizons):
            lengths = history, max(0.0, min(horizon, left))
            rows = prediction_rows(data, (0, len(data.time) - 1), *lengths, skip=skip, ahead=ahead)
            if len(rows) >= FEWEST:
                break
        models = {"model": self.chosen, "physics alone": self.physics}
        found = {
            what: [predicted(Simulator(each.model, data), each.solution.p, rows)]
            for what, each in models.items()
        }
        step = float(np.median(np.diff(self.tests[0].pieces[0].time)))
        found["linear"] = [linear_predictions(self.data, data, rows, self.delay, step)]
        return found

    @functools.cached_property
    def _ratios(self) -> list[Array]:
        """Errors of held-out predictions by the ones of the other blocks so far ahead, by state."""
        parts, found = self._held_out["model"], [[np.empty(0)] for _ in self._deviations]
        for i, part in enumerate(parts):
            others = [each for j, each in enumerate(parts) if j != i]
            for seconds, error, change in zip(part.seconds, part.errors, part.changes, strict=True):
                if not others:
                    break
                size = errors_ahead(others, self.horizons, seconds, self._deviations)
                ratio = np.full_like(error, DIVERGED)
                np.divide(np.abs(error), size, out=ratio, where=error < np.inf)
                for column, r, seen in zip(found, ratio.T, change.T, strict=True):
                    column.append(r[np.isfinite(seen)])
        return [*map(np.concatenate, found)]

    def coverage(self, level: float = 0.9) -> dict[str, float]:
        """Return the share of held-out measurements within the bounds of predictions at a level.

        The bounds come from the errors of the other blocks; NaN with a single one.
        """
        z = float(ndtri(0.5 + 0.5 * level))
        shares = [float(np.mean(r <= z)) if len(r) else math.nan for r in self._ratios]
        return dict(zip(self.noise, shares, strict=True))

    def _widening(self, level: float) -> Array:
        """Return the factor, (n,), at least 1, by which wider bounds hold as many as they say."""
        z = float(ndtri(0.5 + 0.5 * level))
        wide = [np.quantile(r, level) / z if len(r) else 1.0 for r in self._ratios]
        return np.maximum(1.0, wide)

    def whiteness(self) -> dict[str, tuple[float, float]]:
        """Return two correlations of the residuals of each measured state.

        The first is with the residual one row before, the second the largest one with one of the
        last ten inputs; 0 of a model that leaves nothing but white noise.
        """
        model, solution, _, _ = self.chosen
        residuals = Simulator(model, self.data).residuals(solution.p, solution.windows)
        each = [np.arange(first, last + 1) for first, last in solution.windows.rows]
        rows, owners = np.concatenate(each), np.repeat(np.arange(len(each)), [*map(len, each)])
        firsts, u, out = self.data.firsts, self.data.inputs, {}
        for name, column in zip(measured_names(self.plant), residuals.T, strict=True):
            seen = np.flatnonzero(np.isfinite(column))
            now, before = seen[1:], seen[:-1]
            same = owners[now] == owners[before]
            now, before = now[same], before[same]
            at, r = rows[now], column[now]
            inputs = [
                _correlation(r, u[np.maximum(at - lag, firsts[at]), j])
                for lag in range(10)
                for j in range(u.shape[1])
            ]
            out[name] = _correlation(r, column[before]), max(inputs, key=abs)
        return out

    def verdict(self) -> str:
        """Return in a sentence how far ahead the model is worth using."""
        judged, useful = self._judged(), self.useful()
        if not judged:
            return "Not judged: no run is long enough, or moves beyond its noise, to be predicted."
        enough = {horizon: count for horizon, (count, _) in judged.items() if count >= FEWEST}
        if not enough:
            most = counted(max(count for count, _ in judged.values()), "prediction")
            return f"Not judged: {most} at most, but {FEWEST} are expected: give longer runs."
        if not useful:
            return "Do not use this model: it predicts no better than that nothing changes."
        if useful < max(enough):
            return f"Do not use this model beyond {useful:.2g} s."
        how = f"the longest time judged, by {enough[useful]} predictions"
        return f"Useful up to {useful:.2g} s, {how}."

    def useful(self) -> float:
        """Return how far ahead the model is worth using [s]; 0 for not at all, or not judged."""
        judged = self._judged().items()
        enough = [(horizon, is_good) for horizon, (count, is_good) in judged if count >= FEWEST]
        return max((each[0] for each in itertools.takewhile(lambda one: one[1], enough)), default=0)

    def _judged(self) -> dict[float, tuple[int, bool]]:
        """Return, by the time ahead [s], the number of predictions and whether all are good."""
        noise = np.minimum(fast_noise(self.data), self._deviations)
        least = dict(zip(self.noise, MOVING * noise, strict=True))
        found: dict[float, tuple[int, bool]] = {}
        for row in self.errors():
            if row["model"] == "model" and row["nothing_changes"] > least[row["state"]]:
                count, is_good = found.get(row["horizon"], (row["windows"], True))
                is_good &= row["rms"] < USEFUL * row["nothing_changes"]
                found[row["horizon"]] = min(count, row["windows"]), is_good
        return found

    def report(self) -> str:
        """Return what was found, line by line, with units."""
        plant, selection = self.plant, self.selection
        lines = ["Constants (standard errors: windows as clusters, without a network)"]
        for name, (value, error) in self.constants.items():
            unit = " s" if name in ("delay", "lag") and name not in plant.constants else ""
            lines.append(f"  {name:<12} {value:.5g} ± {error:.2g}{unit}")
        lines += [f"  {name:<12} {value:.5g} (given)" for name, value in self.given.items()]
        lines += ["", "Held-out loss of what was tried (mean over blocks, standard error)"]
        lines += [f"  {what:<36} {loss:.4f} ± {error:.4f}" for what, loss, error in selection.table]
        network = "with a network" if self.has_network else "constants alone"
        lines.append(f"  chosen: {network}, windows of {selection.window:.3g} s")
        lines += [f"  note: {note}" for note in selection.notes]
        where = "runs for validation" if self.tests else "held-out blocks"
        alone = "" if self.has_network else "; the model is physics alone"
        lines += ["", f"Error of predictions on {where} (root mean square; median){alone}"]
        rows = [one for one in self.errors() if not alone or one["model"] != "physics alone"]
        for name in self.noise:
            lines.append(f"  {name} [{plant.states[name]}]")
            for horizon in sorted({row["horizon"] for row in rows}):
                here = [row for row in rows if row["state"] == name and row["horizon"] == horizon]
                models = ", ".join(f"{row['model']} {row['rms']:.3g}" for row in here)
                best = next(row for row in here if row["model"] == "model")
                lines.append(
                    f"    {horizon:.3g} s, {counted(best['windows'], 'prediction')}: {models}, "
                    f"nothing changes {best['nothing_changes']:.3g}; median of the model "
                    f"{best['median']:.3g}"
                )
        lines.append("")
        for name, share in self.coverage().items():
            told = "are not judged on" if math.isnan(share) else f"hold {100 * share:.0f} % of"
            lines.append(f"Bounds of 90 % {told} held-out {name}.")
        white = self.whiteness()
        for name, (own, other) in white.items():
            lines.append(
                f"Residuals of {name}: correlation {own:z.2f} with the row before, {other:z.2f} "
                f"with an earlier input (0: white)."
            )
        if self.has_network or any(abs(own) > CORRELATED for own, _ in white.values()):
            lines.append("The equations lack something, which no standard error above contains.")
        return "\n".join([*lines, self.verdict()])

    def store(self, url: str | None = None) -> str:
        """Store the fit as a trial in the results database of the launches.

        Its steps are the rows of the logs, its numbers assessments (:mod:`dopt.fitting.export`).
        What is stored of the same fit already is replaced.

        Parameters
        ----------
        url : str, optional
            Database, such as ``sqlite:///results.db``; by default the one a launch uses.

        Returns
        -------
        str
            Key of the trial.

        Raises
        ------
        StoreError
            If the database fails; what was stored stays.
        ExplorationError
            If the package orchestrate is not installed.
        """
        from dopt.explorer.saving import new_saver

        trial, saver = export.FittedTrial(self), new_saver(url)
        try:
            saver.save(trial, trial.result)
        finally:
            saver.close()
        return trial.trial_key

    def save(self, path: str | Path) -> None:
        """Write the model as arrays (.npz), which NumPy alone reads; pickle keeps the whole fit."""
        if "://" in str(path):
            raise SpecificationError(
                "path is the URL of a database, but a file is expected: give the URL to store()."
            )
        export.save(self, path)

    def to_torch(self) -> Any:
        """Return dx/dt as a module of PyTorch, whose parameters are constants and weights."""
        return export.to_torch(self)

    def environment(self) -> Any:
        """Return the plant as an environment of Gymnasium that begins at states of the logs."""
        return export.environment(self)

    def _whole(self, data: Data, history: float | None) -> Integers:
        """Return first row, last row of the history and last row of the pieces of data."""
        out = []
        history = 0.5 * self.selection.window if history is None else float(history)
        for first in np.unique(data.firsts):
            last, begin = int(data.lasts[first]), int(first)
            elapsed = data.time[first:last] - data.time[first]
            begin += int(np.searchsorted(elapsed, self._latest()))
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

    def _latest(self) -> float:
        values = self.chosen.model.values(self.chosen.solution.p)
        return max(values.delay, 0.0) + 3.0 * values.lag


def _correlation(a: Array, b: Array) -> float:
    if len(a) < 3 or a.std() == 0.0 or b.std() == 0.0:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])
