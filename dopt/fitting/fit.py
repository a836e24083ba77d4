"""A plant fitted to logs: windows, delay, network and weight of the data chosen by validation.

1. The unknown constants are fitted to short windows, with each delay from two samples too early to
   three too late, or later while that fits better, and then to longer ones. The length of windows
   that predicts held-out blocks best is kept.
2. A network is added, with growing weight of the data against the prior. It is kept only where it
   predicts the held-out blocks better than the constants alone by more than one standard error.
3. A level is looked for at which the inputs are cut before they act. Where it predicts the held-out
   blocks better, by more than one standard error or with a third less of what is minimised, all
   begins again with it as the supply.
4. What was chosen is fitted to all logs. Standard errors of the constants come from the fit without
   a network, by leaving out each window: the residuals inside are one curve.

Blocks are logs, or equal parts of fewer than three logs. A held-out window is predicted from an
initial state that is fitted to what comes before it, half a window long.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from dopt.arguments import instance, whole
from dopt.errors import SpecificationError, counted
from dopt.fitting.fitted import Estimate, Fitted, Selection
from dopt.fitting.model import Layout, Model, data_of, measured_names
from dopt.fitting.problem import (
    FEWEST,
    HORIZONS,
    Predicted,
    Simulator,
    Solution,
    Windows,
    first_states,
    left_over,
    linear_predictions,
    predicted,
    prediction_rows,
    solve,
    windows_of,
)
from dopt.fitting.simulation import Data
from dopt.log import Log
from dopt.systems.plant import Plant, Unknown, first_guess
from dopt.types import Array, Integers

BLOCKS = 5
"""Parts into which logs are cut for the validation."""

LENGTHS = (0.2, 0.4, 0.8, 1.6)
"""Lengths of windows that are tried, by the time scale of the log."""

FEWEST_ROWS = 12
"""Fewest rows of a window."""

WEIGHTS = (30.0, 10.0, 3.0)
"""s that are tried, one after the other, by the root mean square of the residuals."""

SCANNED = (-2, -1, 0, 1, 2, 3)
"""Delays that are tried first, in samples from the guess."""

LATEST = 3.0
"""Latest unknown delay that is tried, in standard deviations from its guess."""

MOST_VALIDATED = 200
"""Held-out windows of a block that are predicted."""

RATIO = 1.8
"""Least ratio of the changes over 2k and k rows at which k is short beside the period."""

MOST_LOSS = 1e12
"""Largest mean square of a held-out window, by the typical one, that counts."""

MOST_SCANNED = 150
"""Windows over which delays are tried."""

ROWS_SCANNED = 8000
"""Rows of these windows."""

CUTS = (0.95, 0.85)
"""Levels of the largest input that are tried first as the supply."""

LOWEST_CUT = 0.4

LEAST_FALL, SURE_FALL = 0.1, 1.0 / 3.0
"""Falls of what is minimised, by itself, from which a supply is looked for, and is beyond doubt."""

SURELY = 9.0
"""Fall of what is minimised, of squares of standard errors, that chance does not explain."""

STEP_ERROR = 0.3
"""Largest error of the integration that goes unsaid, in standard deviations of what is left."""


def fit(
    plant: Plant,
    logs: Any,
    *,
    validate: Any = None,
    width: int = 16,
    hold: str = "zero",
    window: float | None = None,
    weights: Sequence[float] = WEIGHTS,
    seed: int = 0,
    workers: int = 2,
    progress: Callable[[str], None] | None = None,
) -> Fitted:
    """Fit a plant's unknown constants, and a network if it helps, to logs by simulation.

    Parameters
    ----------
    plant : Plant
        With :func:`dopt.unknown` constants, delay or lag. Its ``learned`` rows get a network. An
        unknown delay begins at the sample that fits best, of those up to three standard deviations
        late.
    logs : Log, DataFrame, mapping or sequence of them
        Recorded runs (:class:`dopt.Log`); a table is read with the names of the plant.
    validate : the same, optional
        Other runs, on which the report's errors are taken, in place of held-out blocks.
    width : int
        Units of the network that is tried; 0 for none.
    hold : {"zero", "linear", "cubic"}
        Between two rows an input is as in the first one, as a controller holds it, or interpolated,
        where it was measured: by lines, or by a cubic spline where it is smooth, such as a road.
    window : float, optional
        Length of the windows [s], instead of one that is chosen.
    weights : sequence of float
        Values of s that are tried, in decreasing order: how many times larger than they are the
        residuals count as. A small one trusts the data more.
    seed : int
        Seed of the initial weights of the network.
    workers : int
        Blocks that are fitted at the same time.
    progress : callable, optional
        Called with a sentence after each stage.

    Raises
    ------
    SpecificationError
        If nothing is to be fitted, or the logs do not fit the plant or are too short.
    """
    instance("plant", plant, Plant, "a dopt.Plant")
    runs, tests = logs_of(plant, logs), [] if validate is None else logs_of(plant, validate)
    _check(width, weights, workers)
    unknown = [*plant.constants.values(), plant.delay, plant.lag]
    if not (width or any(isinstance(value, Unknown) for value in unknown)):
        raise SpecificationError(
            "the plant has no unknown constant, delay or lag and the network has no units, but "
            "something to fit is expected: declare one with dopt.unknown(), or give a width."
        )
    plant = measuring(plant, runs)
    data = data_of(plant, runs, hold)
    work = _Selection(plant, data, _blocks(data, runs), workers, progress or (lambda _: None))
    seen, given = map(_still, (measured_names(plant), plant.inputs), (data.measured, data.inputs))
    if len(seen) == data.measured.shape[1]:
        raise SpecificationError(
            f"nothing that was measured ({', '.join(seen)}) changes in the logs, but a motion is "
            f"expected: correct the columns, or give a run in which the plant moves."
        )
    work.notes += [
        f"{name} never changes in the logs: constants that need it to stay near their guesses"
        for name in (*seen, *given)
    ]
    work.outliers = sum((run.outliers for run in runs), work.outliers)
    work.notes += [
        f"{counted(number, 'outlier')} of {name} left out" for name, number in work.outliers.items()
    ]
    lengths = work.lengths(window)
    work.scan_delay(lengths[0])
    work.choose_window(lengths)
    network = work.choose_network(width, weights, seed) if width else None
    level = work.supply(*(network or (work.model, work.solution, 1.0)))
    if level is not None:
        again = dataclasses.replace(plant, supply=level)
        options: Any = {"hold": hold, "window": window, "weights": weights, "seed": seed}
        options |= {"width": width, "workers": workers, "progress": progress}
        result = fit(again, runs, validate=tests or None, **options)
        note = (
            f"inputs beyond {level:g} act no more than {level:g} does: they count as cut there, as "
            f"by supply={level:g}; declare the supply, also if it is another one"
        )
        notes, seconds = (note, *result.selection.notes), work.selection(seed).seconds
        result.selection = result.selection._replace(notes=notes, seconds=seconds)
        return result
    physics = work.finish(work.model, work.solution, 1.0)
    chosen = work.finish(*network) if network else physics
    work.check_steps(chosen)
    other = {"zero": "linear", "linear": "cubic"}.get(hold)
    if other and physics.model.n_named:
        work.check_hold(physics, other, data_of(plant, runs, other))
    held_out = work.held_out()
    return Fitted(plant, hold, work.data, chosen, physics, held_out, work.selection(seed), tests)


class _Selection:
    """Choices by validation over blocks so far."""

    def __init__(
        self,
        plant: Plant,
        data: Data,
        blocks: list[tuple[int, int]],
        workers: int,
        say: Callable[[str], None],
    ) -> None:
        self._began = time.perf_counter()
        self.plant, self.data, self.blocks, self.say = plant, data, blocks, say
        self.workers, self._all_blocks = workers, blocks
        self.delay = first_guess(plant.delay)
        self.model = Model(plant)
        self.step = float(np.median(_steps(data)))
        self.scale = time_scale(data)
        self.table: list[tuple[str, float, float]] = []
        self.notes: list[str] = []
        self.outliers = Counter[str]()
        self.window = math.nan
        self._typical: float | None = None
        self._folds: dict[str, tuple[Model, list[Array]]] = {}

    def selection(self, seed: int) -> Selection:
        seconds = time.perf_counter() - self._began
        told = tuple(self.table), self.window, tuple(self.notes), self.outliers
        return Selection(*told, seed, seconds)

    def lengths(self, window: float | None) -> list[float]:
        """Return the lengths of windows that are tried [s], the shortest first."""
        firsts, time = np.unique(self.data.firsts), self.data.time
        longest = float((time[self.data.lasts[firsts]] - time[firsts]).max())
        if window is not None:
            if not (math.isfinite(window) and 2 * self.step < window < longest):
                raise SpecificationError(
                    f"window is {window!r}, but more than two samples of {self.step:g} s and less "
                    f"than the longest piece, {longest:g} s, are expected: correct it."
                )
            return [float(window)]
        least = FEWEST_ROWS * self.step
        tried = sorted({max(share * self.scale, least) for share in LENGTHS})
        longest = min(longest, self._longest_block())
        fitting = [length for length in tried if 4.0 * length <= longest]
        if not fitting and longest <= 2.0 * least:
            raise SpecificationError(
                f"the longest piece of a block, of {len(self.blocks)} that judge the fit, has "
                f"{longest:g} s, but at least {2 * least:g} s, {2 * FEWEST_ROWS} samples, are "
                f"expected: give longer runs."
            )
        if (fitting or [least])[-1] < LENGTHS[1] * self.scale:
            self.notes.append(
                f"the log is short: windows of {(fitting or [least])[-1]:.2g} s are the longest "
                f"that it lets be tried, a period of the motion is about {self.scale:.2g} s: "
                f"record {4.0 * BLOCKS * LENGTHS[-2] * self.scale:.2g} s or more"
            )
        return fitting or [least]

    def _longest_block(self) -> float:
        """Return the longest time of a block without a gap [s]."""
        data, spans = self.data, []
        for first, last in self.blocks:
            for begin in np.unique(data.firsts[first : last + 1]):
                ends = max(first, int(begin)), min(last, int(data.lasts[begin]))
                spans.append(float(data.time[ends[1]] - data.time[ends[0]]))
        return max(spans)

    def _windows(self, seconds: float) -> Windows:
        """Return windows of all blocks, none over a border; also of blocks that judge nothing."""
        skip, ahead = self._latest(), 2.0 * self.step
        rows = np.concatenate(
            [
                windows_of(self.data, *block, seconds, skip=skip, ahead=ahead)
                for block in self._all_blocks
            ]
        )
        return Windows(rows, first_states(self.data, self.model, rows))

    def _latest(self) -> float:
        """Return the longest time from an input to its effect that is tried [s]."""
        return latest_effect(self.plant, self.delay, self.step)

    def scan_delay(self, seconds: float) -> None:
        """Fit the constants to some windows with each delay, and begin from the best one."""
        windows = self._windows(seconds)
        if len(windows.rows) < 2:
            raise SpecificationError(
                f"the logs have {len(windows.rows)} windows of {seconds:g} s, but at least 2 are "
                f"expected: give longer runs, or a shorter window."
            )
        total = int(np.diff(windows.rows, axis=1).sum())
        every = max(1, len(windows.rows) // MOST_SCANNED, total // ROWS_SCANNED)
        some = windows.where(np.arange(len(windows.rows)) % every == 0)
        guess, declared = self.delay, self.plant.delay
        keeps_sign = isinstance(declared, Unknown) and declared.factor > 0
        least = 1e-6 * self.step if keeps_sign else -2.5 * self.step
        latest = declared.at(LATEST) if isinstance(declared, Unknown) else guess

        def one(shift: int) -> tuple[float, Model, Solution]:
            model = Model(self.plant, delay=guess + shift * self.step)
            found = solve(Simulator(model, self.data), some, model.prior, 1.0, most=12)
            counts = some.counts(self.data)
            return float(np.sqrt(np.median(found.squares / counts))), model, found

        fits: dict[int, tuple[float, Model, Solution]] = {}
        shifts = [shift for shift in SCANNED if guess + shift * self.step > least]
        while shifts:
            fits |= zip(shifts, self._map(one, shifts), strict=True)
            best, last = min(fits, key=lambda shift: fits[shift][0]), max(fits)
            later = range(last + 1, last + 1 + len(SCANNED) // 2) if best == last else ()
            shifts = [shift for shift in later if guess + shift * self.step <= latest]
        if not np.isfinite(fits[best][2].squares).any():
            raise SpecificationError(
                f"no window of {seconds:g} s of the logs can be simulated by the equations from "
                f"states that fit it, but some are expected to stay finite and within the plant's "
                f"limit: correct units, zeros of the measured states or guesses of the constants."
            )
        self.say(f"delay: {best:+d} samples from the guess fit best")
        if isinstance(declared, Unknown):
            self.delay += best * self.step
            found = fits[best]
        else:
            found = fits[0]
            if best and fits[best][0] < 0.8 * fits[0][0]:
                self.notes.append(
                    f"with the inputs {best:+d} samples later the constants fit "
                    f"{fits[0][0] / fits[best][0]:.1f} times as well: declare a delay of "
                    f"{self.delay + best * self.step:g} s, or a dopt.unknown one"
                )
        self.data = self.data._replace(deviations=left_over(self.data, *found[1:]))
        p = self.model.extended(found[2].p, found[1])
        self.solution = found[2]._replace(p=p)

    def choose_window(self, lengths: list[float]) -> None:
        """Fit the constants to windows of each length, and keep the one that predicts best."""
        judged = lengths[len(lengths) // 2]
        tested = [self._tested(judged, block) for block in range(len(self.blocks))]
        keep = [block for block, rows in enumerate(tested) if len(rows)]
        if not keep:
            raise SpecificationError(
                f"no held-out block has a window of {1.5 * judged:g} s, but at least one is "
                f"expected, as they judge the fit: give longer runs, or a shorter window."
            )
        self.blocks = [self.blocks[block] for block in keep]  # the rest is fitted to, always
        self._judged = [tested[block] for block in keep]
        best, p = math.inf, self.solution.p
        for length in lengths:
            windows = self._windows(length)
            whole = solve(Simulator(self.model, self.data), windows, p, 1.0)
            p = whole.p
            scores, folds = self._validate(self.model, whole, 1.0)
            self._note(f"constants, windows of {length:.3g} s", scores)
            if scores.mean() < best:
                best, self.window = float(scores.mean()), length
                self.solution, self._scores = whole, scores
                self._folds["model"] = self._folds["physics alone"] = (self.model, folds)

    def choose_network(
        self, width: int, weights: Sequence[float], seed: int
    ) -> tuple[Model, Solution, float] | None:
        """Return the network that predicts best with its weight; None if the constants do."""
        layout = layout_of(self.model, self.data, self.solution.p, self.solution.windows)
        model = self.model.with_network(width, layout, seed)
        counts = self.solution.windows.counts(self.data)
        size = float(np.sqrt(np.median(self.solution.squares / counts)))
        start = self.solution._replace(p=model.extended(self.solution.p, self.model))
        best: tuple[float, Any] = (math.inf, None)
        for weight in sorted(weights, reverse=True):
            s = weight * size
            start = solve(
                *(Simulator(model, self.data), start.windows, start.p, s), scale=start.scale
            )
            scores, folds = self._validate(model, start, s)
            self._note(f"and {width} units, s = {weight:g}", scores)
            if scores.mean() >= best[0]:
                break
            best = float(scores.mean()), (start, s, scores, folds)
        start, s, scores, folds = best[1]
        gain, error = _gain(self._scores, scores)
        if not gain > error:
            self.notes.append(
                f"no network: with it the loss on held-out blocks changes by {-gain:+.3f} ± "
                f"{error:.3f}, which is no clear fall"
            )
            return None
        self._folds["model"], self._scores = (model, folds), scores
        return model, start, s

    def supply(self, model: Model, found: Solution, s: float) -> float | None:
        """Return the level at which all inputs are cut, if held-out blocks say that they are."""
        given, largest = self.data.inputs, float(np.abs(self.data.inputs).max())
        if self.plant.supply < math.inf or not largest:
            return None

        def cut_at(share: float) -> Solution:
            cut = np.clip(given, -share * largest, share * largest)
            simulator = Simulator(model, self.data._replace(inputs=cut))
            return solve(simulator, found.windows, found.p, s, most=12, scale=found.scale)

        def cost(share: float) -> float:
            return cut_at(share).cost(model, s)

        uncut = found.cost(model, s)
        if min(map(cost, CUTS)) > (1.0 - LEAST_FALL) * uncut:
            return None
        best = minimize_scalar(
            cost, bounds=(LOWEST_CUT, 1.0), method="bounded", options={"xatol": 0.001}
        )
        level, whole = float(f"{best.x * largest:.4g}"), cut_at(best.x)
        self.data = self.data._replace(inputs=np.clip(given, -level, level))
        scores, _ = self._validate(model, whole, s)
        self.data = self.data._replace(inputs=given)
        self._note(f"inputs cut at {level:g}", scores)
        gain, error = _gain(self._scores, scores)
        is_sure = best.fun < (1.0 - SURE_FALL) * uncut
        return level if gain > (0.0 if is_sure else error) else None

    def _tested(self, seconds: float, block: int, horizon: float | None = None) -> Integers:
        """Return first row, last row of the history, and last row of held-out predictions."""
        horizon = seconds if horizon is None else horizon
        rows = prediction_rows(
            *(self.data, self.blocks[block], 0.5 * seconds, horizon),
            skip=self._latest(),
            ahead=2.0 * self.step,
        )
        return rows[:: max(1, len(rows) // MOST_VALIDATED)]

    def _validate(self, model: Model, whole: Solution, s: float) -> tuple[Array, list[Array]]:
        """Return for each block how a fit to the others predicts it, and its parameters.

        Each fit begins from the fit to all blocks, which shortens it.
        """

        def one(block: int) -> tuple[Predicted, Array]:
            low, high = self.blocks[block]
            rows = whole.windows.rows
            others = (rows[:, 1] < low) | (rows[:, 0] > high)
            windows = whole.windows.where(others)
            simulator = Simulator(model, self.data)
            found = solve(simulator, windows, whole.p, s, scale=whole.scale[others])
            return predicted(simulator, found.p, self._judged[block]), found.p

        found = list(self._map(one, range(len(self.blocks))))
        shares = [each.mean_squares() for each, _ in found]
        if self._typical is None:
            known = [share for each in shares for share in each if np.isfinite(share)]
            self._typical = max(float(np.median(known)), 1e-300) if known else 1.0
        scores = [
            float(np.mean(np.log1p(np.minimum(each / self._typical, MOST_LOSS))))
            if len(each)
            else math.nan
            for each in shares
        ]
        return np.array(scores), [p for _, p in found]

    def held_out(self) -> dict[str, list[Predicted]]:
        """Return predictions of each block up to the longest horizon, by what made them."""
        for share in reversed(HORIZONS):
            ahead = min(share * self.window, 0.5 * self._longest_block())
            tested = [self._tested(self.window, block, ahead) for block in range(len(self.blocks))]
            if sum(map(len, tested)) >= FEWEST:
                break
        out: dict[str, list[Predicted]] = {}
        for what, (model, folds) in self._folds.items():

            def one(block: int, model: Model = model, folds: list[Array] = folds) -> Predicted:
                return predicted(Simulator(model, self.data), folds[block], tested[block])

            out[what] = list(self._map(one, range(len(self.blocks))))
        out["linear"] = [
            linear_predictions(
                *(self.data, self.data, tested[block], self.delay, self.step), self.blocks[block]
            )
            for block in range(len(self.blocks))
        ]
        return out

    def _map(self, function: Callable[[int], Any], over: Iterable[int]) -> Iterable[Any]:
        with ThreadPoolExecutor(self.workers) as pool:
            return list(pool.map(function, over))

    def _note(self, what: str, scores: Array) -> None:
        error = float(scores.std(ddof=1) / math.sqrt(len(scores))) if len(scores) > 1 else math.nan
        self.table.append((what, float(scores.mean()), error))
        self.say(f"{what}: held-out loss {scores.mean():.4f}")

    def finish(self, model: Model, found: Solution, s: float) -> Estimate:
        """Return the minimum with the covariance of its parameters.

        Without a network each window's influence is the change that leaving it out makes, a
        jackknife: at the minimum residuals are smaller than errors, by much with few windows. The
        many parameters of a network have the influence at the minimum, which takes less memory.
        """
        simulator = Simulator(model, self.data)
        found = solve(simulator, found.windows, found.p, s, scale=found.scale)
        weights = 1.0 / (1.0 + found.squares / found.scale)
        owners = None if model.width else np.arange(len(weights))
        linear = simulator.linear(found.p, found.windows, weights / s**2, owners=owners)
        inverse = np.linalg.inv(linear.normal + np.eye(model.q))
        influence = linear.scores @ inverse
        if not model.width:
            others = linear.normal + np.eye(model.q) - linear.parts
            influence = np.linalg.solve(others, linear.scores[:, :, None])[:, :, 0]
        covariance = influence.T @ influence + inverse @ inverse
        return Estimate(model, found, s, 0.5 * (covariance + covariance.T))

    def check_steps(self, found: Estimate) -> None:
        """Note it where simulations in steps of half the length differ."""
        halved, solution = copy.copy(found.model), found.solution
        longest = 0.5 * found.model.structure.longest_step
        halved.structure = found.model.structure._replace(longest_step=longest)
        residuals = [
            Simulator(model, self.data).residuals(solution.p, solution.windows)
            for model in (found.model, halved)
        ]
        moved = np.subtract(*residuals) * self.data.deviations
        moved /= left_over(self.data, found.model, solution)
        most = float(np.sqrt(np.nanmean(np.square(moved), axis=0)).max())
        if most > STEP_ERROR:
            self.notes.append(
                f"steps of {2 * longest:g} s are too long for these equations: in half of them the "
                f"simulations differ by {most:.2g} standard deviations of what is left; declare a "
                f"smaller dt, or softer corners, such as tanh(rate / 0.5) for tanh(rate / 0.05)"
            )

    def check_hold(self, found: Estimate, other: str, data: Data) -> None:
        """Note it where constants are others if inputs are interpolated in another way.

        A delay is: lines come half a sample before inputs that are held.
        """
        (model, before, s, covariance), windows = found, found.solution.windows
        windows = windows._replace(rows=same_rows(windows.rows, self.data, data))
        simulator = Simulator(model, data._replace(deviations=self.data.deviations))
        after = solve(simulator, windows, before.p, s, most=8, scale=before.scale)
        moved = np.abs(after.p - before.p) / np.sqrt(np.diag(covariance))
        moved = moved[: model.n_named]
        most = int(np.argmax(moved))
        fall = before.cost(model, s) - after.cost(model, s)
        if moved[most] > 1.0 and fall > SURELY:
            self.notes.append(
                f"hold={other!r} fits better, and moves {model.names[most]} by {moved[most]:.2g} "
                f"standard errors, which contain none of it: take it if inputs were measured"
                f"{' and are smooth' if other == 'cubic' else ''}, or record them more often"
            )


def same_rows(rows: Integers, data: Data, other: Data) -> Integers:
    """Return rows of data in others, whose steps between rows have another number of parts."""
    firsts, others = np.unique(data.firsts), np.unique(other.firsts)
    parts = (len(other.time) - len(others)) / (len(data.time) - len(firsts))
    pieces = np.searchsorted(firsts, rows, side="right") - 1
    moved: Integers = others[pieces] + np.round(parts * (rows - firsts[pieces])).astype(np.int64)
    return moved


def _still(names: Iterable[str], columns: Array) -> list[str]:
    """Return the columns, (N, n), that never change, by name."""
    ranges = np.nanmax(columns, axis=0) - np.nanmin(columns, axis=0)
    return [name for name, found in zip(names, ranges, strict=True) if found == 0.0]


def _gain(before: Array, after: Array) -> tuple[float, float]:
    """Return the mean fall of the held-out losses of the blocks, and its standard error."""
    fall = before - after
    error = float(fall.std(ddof=1) / math.sqrt(len(fall))) if len(fall) > 1 else math.inf
    return float(fall.mean()), error


def latest_effect(plant: Plant, delay: float, step: float) -> float:
    """Return the longest time from an input to its effect that is tried [s]."""
    return max(delay, 0.0) + max(SCANNED) * step + 3.0 * first_guess(plant.lag)


def layout_of(model: Model, data: Data, p: Array, windows: Windows) -> Layout:
    """Return scales of a network's features and outputs from simulations of windows."""
    simulator, s = Simulator(model, data), model.structure
    states = np.concatenate(
        [
            simulator.states(p, first, last, start)
            for (first, last), start in zip(*windows, strict=True)
        ]
    )
    rows = np.concatenate([np.arange(a, b + 1) for a, b in windows.rows])
    keep = np.isfinite(states).all(axis=1)
    states, rows = states[keep], rows[keep]
    flow = model.derivative(p, states, data.inputs[rows])
    at, linear = s.feature_indices, s.feature_kinds == 0
    centers = np.where(linear, np.median(states[:, at], axis=0), 0.0)
    spread = np.quantile(np.abs(states[:, at] - centers), 0.95, axis=0) / 2.0
    scales = np.where(linear, np.maximum(spread, 1e-300), 1.0)
    sizes = np.sqrt(np.median(flow[:, s.learned] ** 2, axis=0)) / 2.0
    return Layout(centers, scales, np.maximum(sizes, 1e-300))


def time_scale(data: Data) -> float:
    """Return the shortest period that dominates what is measured [s].

    The change over 2k rows is 2 cos(π k dt/T) times that over k rows, root mean square, of a sine
    of period T; it is less where k is so small that noise decides, and beyond a fraction of T. The
    largest k with a ratio of at least 1.8 gives T; the shortest T of all measured states counts.
    """
    found = []
    for column in data.measured.T:
        seen = np.flatnonzero(np.isfinite(column))
        best, k = 0.0, 1
        while len(seen) > 8 * k:
            spans = [_changes(data, column, seen, n) for n in (k, 2 * k)]
            if min(spans[0][0], spans[1][0]) > 0.0 and spans[1][0] >= RATIO * spans[0][0]:
                best = spans[0][1]
            elif best:
                break
            k = max(k + 1, int(1.25 * k))
        if best:
            found.append(math.pi * best / math.acos(0.5 * RATIO))
    return min(found) if found else 40.0 * float(np.median(_steps(data)))


def _changes(data: Data, column: Array, seen: Integers, k: int) -> tuple[float, float]:
    """Return the root mean square change over k measured rows, and how long they take [s]."""
    same = data.firsts[seen[k:]] == data.firsts[seen[:-k]]
    change = (column[seen[k:]] - column[seen[:-k]])[same]
    seconds = (data.time[seen[k:]] - data.time[seen[:-k]])[same]
    if not len(change):
        return 0.0, 0.0
    return float(np.sqrt(np.mean(np.square(change)))), float(np.median(seconds))


def _steps(data: Data) -> Array:
    """Return the times between two measured rows [s]."""
    seen = np.flatnonzero(np.isfinite(data.measured).any(axis=1))
    same = data.firsts[seen[1:]] == data.firsts[seen[:-1]]
    steps: Array = np.diff(data.time[seen])[same]
    return steps if len(steps) else np.ones(1)


def _blocks(data: Data, runs: Sequence[Log]) -> list[tuple[int, int]]:
    """Return first and last rows of the blocks: logs, or equal parts of fewer than three."""
    N = len(data.time)
    cuts = np.linspace(0, N, BLOCKS + 1).astype(int)
    if len(runs) >= 3:
        ends = np.cumsum([0, *map(len, rows_of_logs(data, runs))])
        parts = min(len(runs), BLOCKS + 1)
        cuts = ends[np.linspace(0, len(runs), parts + 1).round().astype(int)]
    return [(int(a), int(b) - 1) for a, b in itertools.pairwise(cuts) if b > a]


def rows_of_logs(data: Data, runs: Sequence[Log]) -> list[Integers]:
    pieces = iter(np.split(np.arange(len(data.time)), np.unique(data.firsts)[1:]))
    counts = (sum(len(piece.time) > 1 for piece in run.pieces) for run in runs)
    return [np.concatenate([np.arange(0), *itertools.islice(pieces, n)]) for n in counts]


def logs_of(plant: Plant, given: Any) -> list[Log]:
    """Return logs of what was given: logs or tables, one or several."""
    several = given if isinstance(given, list | tuple) else [given]
    if not several:
        raise SpecificationError("no log was given, but at least one is expected: give one.")
    return [one if isinstance(one, Log) else Log.for_plant(one, plant) for one in several]


def measuring(plant: Plant, runs: Sequence[Log]) -> Plant:
    """Return the plant with the states of the logs as measured ones, if it names none."""
    if plant.measured:
        return plant
    measured = {}
    for name in plant.states:
        if all(name in run.states for run in runs):
            columns = [
                piece.measured[:, run.states.index(name)] for run in runs for piece in run.pieces
            ]
            measured[name] = max(1e-3 * float(np.nanstd(np.concatenate(columns))), 1e-300)
    return dataclasses.replace(plant, measured=measured)


def _check(width: int, weights: Sequence[float], workers: int) -> None:
    whole("width", width, 0)
    whole("workers", workers, 1)
    if width and not (len(weights) and all(np.isfinite(w) and w > 0 for w in weights)):
        raise SpecificationError(
            f"weights is {weights!r}, but positive numbers are expected: give for instance "
            f"{list(WEIGHTS)}."
        )
