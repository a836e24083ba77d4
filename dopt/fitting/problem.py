"""Least squares of simulated windows: rows of a log, parameters with priors, damped steps.

What is minimised over the parameters p and the initial states is

    Σ_k ρ(‖e_k‖²) / s² + ‖p - p₀‖²

with e_k the residuals of window k in standard deviations, ρ(r) = c log(1 + r/c) the loss of Cauchy
(windows that nothing fits count little), p in standard deviations of its prior, and s the factor
by which the residuals count as larger than their deviations say: they are smooth curves, so that
few of those in a window are independent. A step is taken by the method of Levenberg and Marquardt.
It eliminates the initial states, whose steps are not damped: where they lead too far, a window that
fits worse than before takes a damped one, so that it holds up no other.

Predictions of parts of a log are at the end, with a linear model for comparison.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types
from scipy.linalg import blas, cho_factor, cho_solve

from dopt.fitting import simulation
from dopt.fitting.model import Model, measured_names
from dopt.fitting.simulation import DERIVATIVES, Data, Problem, Projected, Structure, Values, Work
from dopt.kernel.cache import one_compiler_at_a_time
from dopt.kernel.equations import KNOWN
from dopt.kernel.plain import PLAIN
from dopt.systems.plant import Encoder
from dopt.types import Array, Booleans, Integers

BATCH_ROWS = 1200
"""Rows that are multiplied at once: as many as stay in the processor's cache."""

ROBUSTNESS = 1.0
"""c of ρ, by the median of ‖e_k‖²."""

FIRST_DAMPING = 1.0
"""First damping, by the precision of the prior of a parameter."""

LEAST_DAMPING = 1e-6

LARGEST_DAMPING = 1e12
"""Damping, by the mean precision of a parameter, at which no step is short enough."""

STUCK = 1e12
"""Size of a window that leaves the limit, by c."""


class Linear(NamedTuple):
    """The problem at p, linearised; windows one after the other."""

    normal: Array  # (q, q) Σ RᵀR of the windows, weighted
    slope: Array  # (q,) Σ Rᵀe
    T: Array  # (k, d, d)
    C: Array  # (k, d, q)
    g: Array  # (k, d)
    scores: Array  # (k, q) Rᵀe of each window
    parts: Array  # (n, q, q) Σ RᵀR of the windows of each owner


class Windows(NamedTuple):
    """Windows of a log, by their first and last rows, and their initial states."""

    rows: Integers  # (k, 2)
    starts: Array  # (k, d)

    def where(self, wanted: Booleans | Integers) -> Windows:
        """Return some of the windows."""
        return Windows(
            np.ascontiguousarray(self.rows[wanted]), np.ascontiguousarray(self.starts[wanted])
        )

    @property
    def longest(self) -> int:
        """Most rows of a window."""
        return int(np.max(self.rows[:, 1] - self.rows[:, 0], initial=-1)) + 1

    def counts(self, data: Data) -> Array:
        """Return how many numbers were measured in each."""
        seen = np.concatenate([[0], np.cumsum(np.isfinite(data.measured).sum(axis=1))])
        counts: Array = (seen[self.rows[:, 1] + 1] - seen[self.rows[:, 0]]).astype(float)
        return counts


class Simulator:
    """Simulations of one model over one set of data; not to be shared by threads."""

    def __init__(self, model: Model, data: Data) -> None:
        self.model, self.data = model, data
        self.tolerance = simulation.TOGETHER * float(np.median(np.abs(np.diff(data.time))))
        self._dull, self._sharp = model.work(0), model.work(model.q + model.d)
        self._starts = model.work(model.d)
        self.channels = len(model.structure.measured)
        self._times: tuple[float, ...] = ()
        self._filtered: tuple[Array, Array]

    def squares(self, p: Array, windows: Windows) -> Array:
        """Return ‖e‖² of windows, (k,), inf where one leaves the limit."""
        return self._simulate(p, windows, np.empty((windows.longest, self.model.d)))

    def states(self, p: Array, first: int, last: int, start: Array) -> Array:
        """Return simulated states, (rows, d), NaN from where they leave the limit."""
        out = np.full((last - first + 1, self.model.d), np.nan)
        self._simulate(p, Windows(np.array([[first, last]]), start[None]), out)
        return out

    def residuals(self, p: Array, windows: Windows) -> Array:
        """Return measured less simulated, (rows, n), in standard deviations."""
        measured, out = self.model.structure.measured, []
        for (first, last), start in zip(*windows, strict=True):
            states = self.states(p, first, last, start)[:, measured]
            out.append((self.data.measured[first : last + 1] - states) / self.data.deviations)
        return np.concatenate(out)

    def slopes(self, p: Array, first: int, last: int, start: Array) -> tuple[Array, Array]:
        """Return simulated states, (rows, d), and S, (rows, d, q + d)."""
        rows, d = last - first + 1, self.model.d
        states, S = np.full((rows, d), np.nan), np.full((rows, d, self.model.q + d), np.nan)
        self._simulate(p, Windows(np.array([[first, last]]), start[None]), states, S)
        return states, S

    def _simulate(
        self, p: Array, windows: Windows, states: Array, slopes: Array | None = None
    ) -> Array:
        """Return ‖e‖² of windows; write the states, and S where wanted, of the last one."""
        d, k = self.model.d, len(windows.rows)
        work, S = (self._dull, np.empty((0, d, 0))) if slopes is None else (self._sharp, slopes)
        problem, squares = self._problem(self.model.values(p), work, states, S), np.empty(k)
        shapes = ((0, d), (0, 0), 0, (0, d, d), (0, d, 0), (0, d))
        nothing = Projected(*(np.empty(shape) for shape in shapes))
        call(simulation.simulate, problem, *windows, squares, nothing, squares)
        return squares

    def _problem(self, values: Values, work: Work, states: Array, slopes: Array) -> Problem:
        """Return what windows are simulated with at some values."""
        times = (values.delay, values.lag, values.lag_slope)
        if times != self._times:
            N, m = self.data.inputs.shape
            v, dv = np.empty((N, m)), np.empty((N, m, 2))
            call(simulation.filter_inputs, self.data, values, self.tolerance, self._dull, v, dv)
            self._times, self._filtered = times, (v, dv)
        known = self.model.structure, values, self.data, *self._filtered, self.tolerance
        return Problem(*known, work, states, slopes)

    def settled(self, p: Array, windows: Windows, steps: int = 8) -> Windows:
        """Return the windows with the initial states that fit them best at p."""
        ones = np.ones(len(windows.rows))
        before = self.squares(p, windows)
        for _ in range(steps):
            linear = self.linear(p, windows, ones, starts_only=True)
            moved = windows._replace(starts=_moved(windows.starts, linear, np.zeros(0)))
            after = self.squares(p, moved)
            better = after < before
            if not better.any():
                break
            starts = np.where(better[:, None], moved.starts, windows.starts)
            fall = float(np.max(1.0 - after[better] / before[better]))
            windows, before = windows._replace(starts=starts), np.minimum(before, after)
            if fall < 1e-4:
                break
        return windows

    def linear(
        self,
        p: Array,
        windows: Windows,
        weights: Array,
        *,
        starts_only: bool = False,
        owners: Integers | None = None,
    ) -> Linear:
        """Return the problem linearised at p, with a weight for each window's squares.

        With ``starts_only`` it is linearised by the initial states alone, q = 0. With the number of
        the owner of each window, its part of the sum is returned as well.
        """
        model, d = self.model, self.model.d
        q, work = (0, self._starts) if starts_only else (model.q, self._sharp)
        k, longest = len(windows.rows), windows.longest
        room = np.empty((longest, d)), np.empty((longest, d, q + d))
        problem = self._problem(model.values(p), work, *room)
        normal, slope = np.zeros((q, q), order="F"), np.zeros(q)
        T, C, g = np.zeros((k, d, d)), np.zeros((k, d, q)), np.zeros((k, d))
        scores = np.zeros((k, q))
        parts = np.zeros((0 if owners is None else int(np.max(owners, initial=-1)) + 1, q, q))
        roots, squares = np.sqrt(weights), np.empty(k)
        sizes = (windows.rows[:, 1] - windows.rows[:, 0] + 1) * self.channels
        Q = np.empty((longest * self.channels, d))
        for first, last in _batches(sizes):
            part, n = slice(first, last), int(sizes[first:last].sum())
            R, e = np.zeros((n, q)), np.zeros(n)
            into = Projected(Q, R, e, T[part], C[part], g[part])
            some = windows.rows[part], windows.starts[part], roots[part]
            call(simulation.simulate, problem, *some, into, squares[part])
            if q:
                normal = blas.dsyrk(1.0, R.T, beta=1.0, c=normal, overwrite_c=True)
                slope += e @ R
            ends = np.concatenate([[0], np.cumsum(sizes[part])])
            for i in range(last - first if q else 0):
                own = slice(ends[i], ends[i + 1])
                scores[first + i] = e[own] @ R[own]
                if owners is not None:
                    parts[owners[first + i]] += R[own].T @ R[own]
        normal = np.triu(normal) + np.triu(normal, 1).T
        return Linear(normal, slope, T, C, g, scores, parts)


def _batches(sizes: Integers) -> Iterator[tuple[int, int]]:
    """Return ranges of windows of about ``BATCH_ROWS`` rows each."""
    batch = np.cumsum(sizes) // BATCH_ROWS
    return itertools.pairwise([0, *(np.flatnonzero(np.diff(batch, append=-1)) + 1).tolist()])


class Solution(NamedTuple):
    """A minimum."""

    p: Array
    windows: Windows
    squares: Array  # (k,)
    scale: Array  # (k,) c of each window
    steps: int
    converged: bool

    def cost(self, model: Model, s: float) -> float:
        """Return what is minimised."""
        prior = np.sum((self.p - model.prior) ** 2)
        return float(robust(self.squares, self.scale).sum() / s**2 + prior)


def robust(squares: Array, scale: Array) -> Array:
    """Return ρ of each window."""
    return scale * np.log1p(np.minimum(squares / scale, STUCK))


def robust_scale(squares: Array, counts: Array) -> Array:
    """Return c of each window."""
    finite = np.isfinite(squares)
    share = squares[finite] / counts[finite]
    typical = float(np.median(share)) if len(share) else 1.0
    return ROBUSTNESS * max(typical, 1e-300) * counts


def solve(
    simulator: Simulator,
    windows: Windows,
    p: Array,
    s: float,
    *,
    most: int = 30,
    scale: Array | None = None,
    tolerance: float = 1e-3,
) -> Solution:
    """Minimise over p and the initial states, from given ones."""
    model, counts = simulator.model, windows.counts(simulator.data)
    squares = simulator.squares(p, windows)
    scale = robust_scale(squares, counts) if scale is None else scale

    def cost(squares: Array, p: Array) -> float:
        return Solution(p, windows, squares, scale, 0, False).cost(model, s)

    value, damping, calm, steps = cost(squares, p), FIRST_DAMPING, 0, 0
    converged = False
    while steps < most and not converged:
        steps += 1
        weights = 1.0 / (1.0 + squares / scale)
        linear = simulator.linear(p, windows, weights / s**2)
        H, b = linear.normal + np.eye(model.q), linear.slope - (p - model.prior)
        possible = b @ np.linalg.solve(H, b)  # fall that is foreseen without damping
        growth, new = 2.0, math.inf
        size = max(np.trace(H) / max(model.q, 1), 1.0)
        while damping < LARGEST_DAMPING * size:
            factor = cho_factor(H + damping * np.eye(model.q), check_finite=False)
            step = cho_solve(factor, b, check_finite=False)
            trial = p + step
            moved = windows._replace(starts=_moved(windows.starts, linear, step))
            after, held = simulator.squares(trial, moved), np.empty(0, int)
            if not cost(after, trial) < value:
                share = size / (size + damping)  # about as p is damped
                damped = windows._replace(starts=_moved(windows.starts, linear, step, share))
                worse = np.flatnonzero(after > squares)
                others = simulator.squares(trial, damped.where(worse))
                better = others < after[worse]
                held = worse[better]
                moved.starts[held] = damped.starts[held]
                after[held] = others[better]
            new = cost(after, trial)
            if new < value:
                break
            damping *= growth
            growth *= 2.0
        if not new < value:
            converged = bool(possible + np.sum(linear.g**2) < tolerance * value)
            break
        fall, foreseen = value - new, float(step @ (b + damping * step))
        ratio = fall / foreseen if foreseen > 0.0 else 1.0
        damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), LEAST_DAMPING)
        p, windows, squares = trial, moved, after
        small = fall < tolerance * value and possible < 10.0 * tolerance * value
        calm = calm + 1 if small and not len(held) else 0
        value, converged = new, calm >= 2
    return Solution(p, windows, squares, scale, steps, converged)


def _moved(starts: Array, linear: Linear, step: Array, share: float = 1.0) -> Array:
    """Return the initial states after a step of the parameters, and a share of their own step."""
    right = share * linear.g - linear.C @ step
    d = starts.shape[1]
    delta = np.zeros_like(starts)
    for i in range(d - 1, -1, -1):  # back substitution, a column without a pivot stays
        rest = right[:, i] - np.einsum("kj,kj->k", linear.T[:, i, i + 1 :], delta[:, i + 1 :])
        pivot = linear.T[:, i, i]
        delta[:, i] = np.divide(rest, pivot, out=np.zeros_like(rest), where=pivot != 0)
    return starts + delta


def call(function: Any, *arguments: Any) -> Any:
    """Call a compiled function, with the known part as a pointer: it is compiled once for all."""
    if PLAIN:
        return function(*arguments)
    key = function, *map(_key, arguments)
    if key not in _codes:
        kinds = tuple(map(_kind, arguments))
        digest = hashlib.sha256(f"{simulation.DIGEST}{kinds}".encode()).hexdigest()[:16]
        with one_compiler_at_a_time(f"{function.__module__}.{function.__name__}-{digest}"):
            _codes[key] = function.compile(kinds)
    return _codes[key](*arguments)


_codes: dict[Any, Any] = {}


def _key(value: Any) -> Any:
    """Return what decides the type of an argument, which takes Numba far longer to tell."""
    if isinstance(value, np.ndarray):
        f = value.flags
        return value.dtype.char, value.ndim, f.c_contiguous, f.f_contiguous, f.writeable
    return (type(value), *map(_key, value)) if isinstance(value, tuple) else type(value)


def _kind(value: Any) -> Any:
    if isinstance(value, Structure):
        functions = [types.FunctionType(KNOWN), types.FunctionType(DERIVATIVES)]
        return types.NamedTuple([*functions, *map(_kind, value[2:])], Structure)
    if isinstance(value, tuple):
        return types.NamedTuple([*map(_kind, value)], type(value))
    if isinstance(value, bool | np.bool_):
        return types.boolean
    if isinstance(value, int | np.integer):
        return types.int64
    return types.float64 if isinstance(value, float) else numba.typeof(value)


def left_over(data: Data, model: Model, found: Solution) -> Array:
    """Return the standard deviation of each measured state from what a fit has left, (n,)."""
    residuals = Simulator(model, data).residuals(found.p, found.windows)
    typical = 1.4826 * np.nanmedian(np.abs(residuals), axis=0)
    floors = []
    for name, column in zip(measured_names(model.plant), data.measured.T, strict=True):
        noise = model.plant.measured.get(name)
        rounded = 1e-9 * max(float(np.nanstd(column)), 1e-300)
        floors.append(noise.noise if isinstance(noise, Encoder) else rounded)
    left: Array = data.deviations * np.maximum(typical, np.array(floors) / data.deviations)
    return left


def windows_of(
    data: Data, first: int, last: int, seconds: float, *, skip: float, ahead: float
) -> Integers:
    """Return windows of so many seconds, (k, 2), one after the other within some rows.

    Each begins ``skip`` seconds after its piece does, so that the input that acts is known, and
    ends ``ahead`` seconds before the piece does.
    """
    out, row = [], first
    measured = np.flatnonzero(np.isfinite(data.measured[first : last + 1]).any(axis=1)) + first
    while row <= last:
        at = np.searchsorted(measured, row)
        if at >= len(measured):
            break
        row = int(measured[at])
        begin, end = data.firsts[row], min(data.lasts[row], last)
        if data.time[row] - data.time[begin] < skip:
            row += 1
            continue
        stop = row + int(np.searchsorted(data.time[row : end + 1], data.time[row] + seconds))
        late = stop > end or data.time[stop] + ahead > data.time[data.lasts[row]]
        if late:
            row = int(data.lasts[row]) + 1
            continue
        out.append((row, stop))
        row = stop
    return np.array(out, np.int64).reshape(-1, 2)


AROUND = 7
"""Measurements from which an initial state is first estimated, by a parabola."""


def first_states(data: Data, model: Model, rows: Integers) -> Array:
    """Return first estimates of the initial states of windows, (k, d)."""
    starts, measured = np.zeros((len(rows), model.d)), model.structure.measured
    rate = {of: (j, unit) for j, (of, unit) in model.rates.items()}
    for k, (row, end) in enumerate(rows):
        low = max(int(data.firsts[row]), row - 60)
        near = slice(low, min(int(data.lasts[row]), max(end, row + 60)) + 1)
        t = data.time[near] - data.time[row]
        for c, i in enumerate(measured):
            seen = np.flatnonzero(np.isfinite(data.measured[near, c]))
            seen = seen[np.argsort(np.abs(t[seen]), kind="stable")[:AROUND]]
            if not len(seen):
                continue
            span = max(float(np.abs(t[seen]).max()), 1e-300)
            degree = min(2, len(seen) - 1)
            found = np.polyfit(t[seen] / span, data.measured[near, c][seen], degree)
            starts[k, i] = found[-1]
            if int(i) in rate and degree:
                j, unit = rate[int(i)]
                starts[k, j] = found[-2] / span / unit
    return starts


HORIZONS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Times ahead of which errors are reported, by the length of the windows."""

FEWEST = 5
"""Fewest predictions that judge a model: of fewer, they go less far ahead."""

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
        """Return errors and changes, (windows, n), at the last measurement up to a time.

        It is NaN of a state that was not measured in the last fifth of the time.
        """
        n = len(self.deviations)
        found = np.full((2, len(self.seconds), n), np.nan)
        for k, (seconds, *both) in enumerate(
            zip(self.seconds, self.errors, self.changes, strict=True)
        ):
            late = (seconds <= horizon * (1 + 1e-9)) & (seconds >= 0.8 * horizon)
            for c in range(n):
                for row in np.flatnonzero(late & np.isfinite(both[1][:, c]))[-1:]:
                    found[:, k, c] = [part[row, c] for part in both]
        errors, changes = found[:, np.isfinite(found[1]).any(axis=1)]
        return errors, changes


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
    data: Data, rows: tuple[int, int], history: float, horizon: float, *, skip: float, ahead: float
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
        errors, changes = map(np.concatenate, zip(*both, strict=True))
        seen = np.isfinite(changes)
        if not (len(seen) and seen.any(axis=0).all()):
            continue
        row = []
        for c, here in enumerate(seen.T):
            error, change = errors[here, c], changes[here, c]
            rms, moved = (float(np.sqrt(np.mean(np.square(one)))) for one in (error, change))
            median = float(np.median(np.abs(error)))
            row.append(HorizonError(horizon, rms, median, moved, len(error)))
        out.append(row)
    return out


def errors_ahead(
    found: Sequence[Predicted], horizons: Sequence[float], seconds: Array, noise: Array
) -> Array:
    """Return the root mean square errors of predictions so far ahead [s], (N, n).

    They are interpolated between the horizons; at 0 they are the noise, (n,), below which they do
    not fall. Beyond the last horizon they grow by the power of the time, up to 1, by which they
    grew from the first one on.
    """
    rows = horizon_errors(found, horizons)
    times = [0.0, *(row[0].horizon for row in rows)]
    out = np.empty((len(seconds), len(noise)))
    for c, deviation in enumerate(noise):
        errors = [deviation, *(max(row[c].rms, deviation) for row in rows)]
        out[:, c] = np.interp(seconds, times, errors)
        if len(times) > 2 and 0.0 < errors[1] < errors[-1] < np.inf:
            power = math.log(errors[-1] / errors[1]) / math.log(times[-1] / times[1])
            out[:, c] *= np.maximum(seconds / times[-1], 1.0) ** min(power, 1.0)
    return out


def fast_noise(data: Data) -> Array:
    """Return the standard deviation of what is fast in each measured state, (n,): noise at most."""
    out = np.zeros(data.measured.shape[1])
    for c, column in enumerate(data.measured.T):
        seen = np.flatnonzero(np.isfinite(column))
        bends = np.diff(column[seen], 2)[data.firsts[seen[2:]] == data.firsts[seen[:-2]]]
        out[c] = 1.4826 * float(np.median(np.abs(bends))) / math.sqrt(6.0) if len(bends) else 0.0
    return out


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
    depth, out = ORDER + late, Predicted([], [], [], data.deviations)

    def of(each: Data) -> tuple[Integers, Array, Array]:
        seen = np.flatnonzero(np.isfinite(each.measured).all(axis=1))
        return seen, (each.measured[seen] - level) / scale, each.inputs[seen] / size

    def past(inputs: Array, k: Any) -> list[Array]:
        return [inputs[k - 1 - late - i] for i in range(ORDER)]  # the newest first

    at, outputs, inputs = of(train)
    k = np.arange(depth, len(at))
    k = k[train.firsts[at[k]] == train.firsts[at[k - depth]]]
    if without is not None:
        k = k[(at[k] < without[0]) | (at[k - depth] > without[1])]
    if not len(k):
        return out
    newest = [outputs[k - 1 - i] for i in range(ORDER)]
    regressors = np.concatenate([*newest, *past(inputs, k), np.ones((len(k), 1))], axis=1)
    theta = np.linalg.lstsq(regressors, outputs[k], rcond=None)[0]
    at, outputs, inputs = of(data)
    for begin, middle, last in rows:
        ahead = np.flatnonzero((at > middle) & (at <= last))
        before = np.flatnonzero((at >= begin) & (at <= middle))
        if len(before) < depth + 1 or not len(ahead):
            continue
        path = list(outputs[before[-ORDER:]][::-1])  # the newest first
        for row in ahead:
            one = np.concatenate([*path[:ORDER], *past(inputs, row), [1.0]])
            path.insert(0, np.clip(one @ theta, -1e9, 1e9))
        simulated = np.array(path[: len(ahead)])[::-1]
        out.seconds.append(data.time[at[ahead]] - data.time[middle])
        out.errors.append((outputs[ahead] - simulated) * scale)
        out.changes.append((outputs[ahead] - outputs[before[-1]]) * scale)
    return out
