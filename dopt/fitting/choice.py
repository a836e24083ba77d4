"""Choice of recorded segments, or of input signals, by what they tell of a plant's parameters.

A candidate has the sensitivities J of its simulation, (rows, q): derivatives of what is measured by
the parameters, of which each is in standard deviations of its prior, in units of the residuals that
are expected. One after the other is taken the candidate that raises most

    log det(I + Σ JᵀJ)

over what was taken before and it. What the unknown initial state of a recorded window could explain
is taken out of J; a signal begins at a state that is given. Without fits in between, the sum is at
least 1 - 1/e of the largest of as many candidates, because log det is submodular.

Logs have the residuals e of the whole pool, too. Candidate j, with what was taken before, would
move the parameters by

    δ = (I + Σ JᵀJ)⁻¹ (Σ Jᵀe - (p - p₀)),

and by error is taken the one after which the pool's Σ ‖e - J δ‖² is least. Where the model cannot
fit everything, log det takes extremes; by error the constants become less certain.

References: V. Fedorov, "Theory of optimal experiments" (1972); G. Nemhauser, L. Wolsey and
M. Fisher, "An analysis of approximations for maximizing submodular set functions" (1978).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dopt.arguments import finite, instance, reals, whole, within
from dopt.errors import SpecificationError, unknown_name
from dopt.fitting.fit import (
    FEWEST_ROWS,
    LENGTHS,
    latest_effect,
    layout_of,
    logs_of,
    measuring,
    rows_of_logs,
    time_scale,
)
from dopt.fitting.fitted import Fitted
from dopt.fitting.model import Model, data_of, measured_names
from dopt.fitting.problem import Simulator, Windows, first_states, left_over, solve, windows_of
from dopt.fitting.simulation import Data
from dopt.log import Log, Piece
from dopt.systems.plant import Plant, first_guess
from dopt.types import Array, Integers

ORDERS = ("information", "error", "random")

LEAST = 0.1
"""Least residuals of the constants that a network is weighed by, in deviations."""


class State(NamedTuple):
    """Knowledge of a plant: the parameters at which information is computed."""

    model: Model
    p: Array  # (q,)
    s: float  # residuals count as so many times larger
    covariance: Array  # (q, q) inverse of I + Σ JᵀJ

    @property
    def constants(self) -> dict[str, tuple[float, float]]:
        """Value and expected standard error of each unknown constant, of delay and lag [s]."""
        return self.model.with_errors(self.p, self.covariance)


@dataclass(frozen=True)
class Choice:
    """Candidates in the order in which they are worth taking (:func:`dopt.choose`).

    Attributes
    ----------
    indices : tuple of int
        Places in the pool, or among its segments; without ``taken``.
    gains, shares : (k,) arrays
        What each raised log det by, at what was known when it was taken; information of all taken
        so far by the information of the whole pool, as differences of log det.
    logs : tuple of Log
        What was chosen, for :func:`dopt.fit`; empty for signals.
    places : tuple of str
        Where each of them is found.
    states : tuple of State
        What was known before the first choice, and, with a refit, after each.
    pool : int
        Number of candidates.
    """

    indices: tuple[int, ...]
    gains: Array
    shares: Array
    logs: tuple[Log, ...]
    places: tuple[str, ...]
    states: tuple[State, ...]
    pool: int

    def report(self) -> str:
        """Return what was chosen and what is known by then, line by line."""
        last, when = self.states[-1], "after the last" if len(self.states) > 1 else "before"
        rows = enumerate(zip(self.places, self.gains, self.shares, strict=True), 1)
        return "\n".join(
            [
                f"{len(self.indices)} of {self.pool} candidates, {last.model.q} parameters",
                *(
                    f"  {n:>3}. {place}: log det +{gain:.3g}, {share:.1%} of the pool's information"
                    for n, (place, gain, share) in rows
                ),
                f"Constants {when} (expected standard errors)",
                *(f"  {name:<12} {v:.5g} ± {e:.2g}" for name, (v, e) in last.constants.items()),
            ]
        )


def choose(
    plant: Plant | Fitted,
    pool: Any,
    k: int,
    *,
    seconds: float | None = None,
    start: npt.ArrayLike | None = None,
    taken: Sequence[int] = (),
    refit: bool = True,
    by: str = "information",
    width: int = 16,
    weight: float = 3.0,
    window: float | None = None,
    hold: str = "zero",
    seed: int = 0,
) -> Choice:
    """Choose k recorded segments, or input signals, that tell most of a plant's parameters.

    Parameters
    ----------
    plant : Plant or Fitted
        With :func:`dopt.unknown` constants. Of a fit, what it was fitted to counts as known, and
        ``width``, ``weight`` and ``hold`` are its own.
    pool : sequence of Log, table or array
        Candidates: logs (or tables, as :func:`dopt.fit` takes them), or, with ``start``, signals,
        each (N, m), whose rows are held for ``plant.dt``.
    k : int
        How many to choose.
    seconds : float, optional
        Cut the logs into segments of so many seconds, which are the candidates.
    start : (d,) array, optional
        State at which every signal begins.
    taken : sequence of int
        Candidates that are taken already.
    refit : bool
        Fit the model to what was taken after each choice; never to signals, which have not run.
    by : {"information", "error", "random"}
        What raises most log det; or, of logs, what lowers most the error of the whole pool, for
        predictions of a model that cannot fit everything; or an order drawn by the seed.
    width : int
        Units of the network beside the known part; 0 for none.
    weight : float
        How many times larger than they are the residuals of a network count as, because those in a
        window are one smooth curve.
    window : float, optional
        Longest window [s], whose initial state is unknown; .8 of the time scale by default.
    hold : {"zero", "linear", "cubic"}
        As of :func:`dopt.fit`.
    seed : int
        Of the initial weights of the network, and of a random order.

    Raises
    ------
    SpecificationError
        If the pool is no pool of the plant, or holds fewer than k candidates, or if signals are to
        be taken by error.
    """
    instance("plant", plant, Plant | Fitted, "a dopt.Plant or a result of dopt.fit")
    if by not in ORDERS:
        raise unknown_name("order in 'by'", by, ORDERS)
    if by == "error" and start is not None:
        raise SpecificationError(
            "by is 'error' with signals, but logs, in which the outputs were measured, are "
            "expected: leave by out."
        )
    declared = plant.plant if isinstance(plant, Fitted) else plant
    if start is not None:
        start = finite("start", start, len(declared.states))
        logs, places = _signals(declared, pool, seconds)
    else:
        logs, places = _recorded(declared, pool, seconds)
    n = len(logs)
    chosen = [whole("an index in taken", i, 0, n - 1) for i in taken]
    if len({*chosen}) < len(chosen) or whole("k", k, 0) + len(chosen) > n:
        raise SpecificationError(
            f"k is {k} and taken is {chosen}, but different candidates, at most {n} in all, are "
            f"expected: correct them."
        )
    size = whole("width", width, 0), within("weight", weight, math.inf)
    search = _Search(plant, logs, start, hold, seconds, window)
    search.add_network(*size, seed)
    states, gains, shares = list[State](), list[float](), list[float]()
    order, first = np.random.default_rng(seed).permutation(n), len(chosen)
    refit = refit and start is None
    for step in range(k + 1):
        if refit and chosen:
            search.fit(chosen)
        if step == 0 or refit:
            base, each, slopes = search.information()
            before, whole_pool = _log_det(base), _log_det(base + each.sum(axis=0))
        M = base + each[chosen].sum(axis=0)
        if step == 0 or refit:
            states.append(State(search.model, search.p, search.s, np.linalg.inv(M)))
        if step:
            shares.append((_log_det(M) - before) / max(whole_pool - before, 1e-300))
        if step < k:
            more = _log_det(M + each) - _log_det(M)
            known = slopes[0] + slopes[1:][chosen].sum(axis=0)
            worth = _falls(M, each, known, slopes[1:]) if by == "error" else more
            worth[chosen] = -np.inf
            drawn = (int(j) for j in order if j not in chosen)
            chosen.append(next(drawn) if by == "random" else int(np.argmax(worth)))
            gains.append(float(more[chosen[-1]]))
    new = tuple(chosen[first:])
    found = tuple(logs[i] for i in new if start is None), tuple(places[i] for i in new)
    return Choice(new, np.array(gains), np.array(shares), *found, tuple(states), n)


def _log_det(M: Array) -> Any:
    return np.linalg.slogdet(M)[1]


def _falls(M: Array, each: Array, slope: Array, slopes: Array) -> Array:
    """Return by how much the pool's squares fall with each candidate, (n,), to first order in J."""
    steps = np.linalg.solve(M + each, (slope + slopes)[:, :, None])[:, :, 0]
    falls: Array = 2.0 * steps @ slopes.sum(axis=0) - np.sum(
        steps @ each.sum(axis=0) * steps, axis=1
    )
    return falls


def _signals(plant: Plant, pool: Any, seconds: float | None) -> tuple[list[Log], list[str]]:
    """Return signals as logs in which 0 was measured, and their names."""
    if not plant.measured or seconds is not None:
        raise SpecificationError(
            f"signals were given with seconds {seconds!r} and the measured states "
            f"{[*plant.measured]}, but whole signals and the noise of what will be measured are "
            f"expected: leave seconds out, and declare 'measured' in the plant."
        )
    logs, names, m = [], measured_names(plant), len(plant.inputs)
    for i, one in enumerate(pool):
        u: Array = reals(f"inputs of signal {i}", one)
        u = u[:, None] if u.ndim == m == 1 else u
        if u.ndim != 2 or u.shape[1] != m or len(u) < 2 or not np.isfinite(u).all():
            raise SpecificationError(
                f"signal {i} has the shape {u.shape}, but finite inputs of the shape (N, {m}), N "
                f"at least 2, are expected: correct it."
            )
        piece = Piece(plant.dt * np.arange(float(len(u))), np.zeros((len(u), len(names))), u)
        logs.append(Log.of_pieces(names, [*plant.inputs], [piece]))
    return logs, [f"signal {i}" for i in range(len(logs))]


def _recorded(plant: Plant, pool: Any, seconds: float | None) -> tuple[list[Log], list[str]]:
    """Return logs, or segments of them, and where they are."""
    pool = pool if isinstance(pool, list | tuple) else [pool]
    if any(isinstance(one, np.ndarray) for one in pool):
        raise SpecificationError(
            "the pool holds arrays, but logs are expected, or signals with the state at which they "
            "begin: give start."
        )
    logs = logs_of(plant, pool)
    if seconds is not None:
        return segments_of(plant, logs, within("seconds", seconds, math.inf))
    return logs, [f"log {i}" for i in range(len(logs))]


def segments_of(plant: Plant, logs: Sequence[Log], seconds: float) -> tuple[list[Log], list[str]]:
    """Return segments of logs, each with the inputs around it that act, and where they are."""
    out, places = [], []
    for number, log in enumerate(logs):
        step = log.step
        lead, tail = (margin + step for margin in _margins(plant, step))
        both = zip(log.pieces, log.left_out, strict=True) if seconds > 2 * step else ()
        for (time, measured, inputs), lost in both:
            begin = time[0] + lead
            while begin + seconds + tail <= time[-1]:
                ends = begin - lead - 0.5 * step, begin + seconds + tail + 0.5 * step
                rows = slice(*np.searchsorted(time, ends))
                piece = Piece(time[rows], measured[rows], inputs[rows])
                out.append(Log.of_pieces(log.states, log.inputs, [piece]))
                out[-1].left_out = (lost[rows],)
                places.append(f"log {number}, {begin:.6g} to {begin + seconds:.6g} s")
                begin += seconds
    if not out:
        raise SpecificationError(
            f"seconds is {seconds:g}, but segments of more than two samples, and shorter than the "
            f"pieces of the logs, are expected: change it."
        )
    return out, places


def _margins(plant: Plant, step: float) -> tuple[float, float]:
    """Return how long before and after a window its inputs have to be known [s]."""
    return latest_effect(plant, first_guess(plant.delay), step), 2.0 * step


class _Search:
    """The model at what is known, and the windows of all candidates; owner -1: of a fit before."""

    def __init__(
        self,
        given: Plant | Fitted,
        logs: Sequence[Log],
        start: Array | None,
        hold: str,
        *lengths: float | None,
    ) -> None:
        fitted = given if isinstance(given, Fitted) else None
        self.plant = given.plant if isinstance(given, Fitted) else measuring(given, logs)
        self.n, self.known_start = len(logs), start is not None
        hold = "zero" if self.known_start else fitted.hold if fitted else hold
        self.data = data_of(self.plant, logs, hold)
        self.noise, rows = self.data.deviations, self._rows(logs, *lengths)
        if fitted:
            self.physics, self.model = fitted.physics.model, fitted.chosen.model
            self.constants, self.p = fitted.physics.solution.p, fitted.chosen.solution.p
            self.s = self.weight = fitted.chosen.s
            before = len(fitted.data.time)
            rows = [fitted.chosen.solution.windows.rows, *(each + before for each in rows)]
            self.data = _joined(fitted.data, self.data)
        else:
            self.physics = self.model = Model(self.plant)
            self.constants, self.p, self.s = self.model.prior, self.model.prior, 1.0
        both = np.concatenate(rows)
        owners = np.arange(-1 if fitted else 0, self.n)
        self.owners = np.repeat(owners, [len(each) for each in rows])
        self.free = (self.owners < 0) | (not self.known_start)  # windows of an unknown start
        self.windows = Windows(both, first_states(self.data, self.model, both))
        if start is not None:
            self.windows.starts[~self.free] = start
        self._settle()

    def _rows(
        self, logs: Sequence[Log], seconds: float | None, longest: float | None
    ) -> list[Integers]:
        """Return first and last rows of the windows of each candidate, (w, 2)."""
        ends = [(int(one[0]), int(one[-1])) for one in rows_of_logs(self.data, logs)]
        if self.known_start:
            return [np.array([both]) for both in ends]
        step = float(np.median([log.step for log in logs]))
        default = max(LENGTHS[2] * time_scale(self.data), FEWEST_ROWS * step)
        length = default if longest is None else within("window", longest, math.inf)
        if seconds is not None:
            length = seconds / math.ceil(seconds / length - 1e-9) - 0.5 * step
        skip, ahead = _margins(self.plant, step)
        rows = [windows_of(self.data, *both, length, skip=skip, ahead=ahead) for both in ends]
        if not any(map(len, rows)):
            raise SpecificationError(
                f"no candidate has a window of {length:.3g} s between {skip:.3g} s after it begins "
                f"and {ahead:.3g} s before it ends, but one at least is expected: give longer logs."
            )
        return rows

    def add_network(self, width: int, weight: float, seed: int) -> None:
        """Add a network to the model of a plant that was not fitted."""
        if width and not (self.owners < 0).any():
            layout = layout_of(self.physics, self.data, self.p, self.windows)
            self.model = self.physics.with_network(width, layout, seed)
            self.s = self.weight = weight
            self.p = self.model.extended(self.p, self.physics)
        if not self.model.q:
            raise SpecificationError(
                "the plant has no unknown constant, delay or lag and there is no network, but "
                "something to learn is expected: declare one with dopt.unknown(), or give a width."
            )

    def _settle(self) -> None:
        """Move the initial states that are unknown to where they fit best."""
        if self.free.any():
            simulator = Simulator(self.model, self.data)
            found = simulator.settled(self.p, self.windows.where(self.free))
            self.windows.starts[self.free] = found.starts

    def fit(self, chosen: Sequence[int]) -> None:
        """Fit the constants, and then a network, to some candidates and to what was known."""
        windows = self.windows.where(np.isin(self.owners, [-1, *chosen]))
        if not len(windows.rows):
            return
        found = solve(Simulator(self.physics, self.data), windows, self.constants, 1.0)
        left = left_over(self.data, self.physics, found)
        self.data = self.data._replace(deviations=np.maximum(left, self.noise))
        found = solve(Simulator(self.physics, self.data), found.windows, found.p, 1.0)
        self.constants = self.p = found.p
        if self.model is not self.physics:
            size = np.sqrt(np.median(found.squares / found.windows.counts(self.data)))
            self.s = self.weight * max(float(size), LEAST)
            p = self.model.extended(found.p, self.physics)
            simulator = Simulator(self.model, self.data)
            self.p = solve(simulator, found.windows, p, self.s, scale=found.scale).p
        self._settle()

    def information(self) -> tuple[Array, Array, Array]:
        """Return JᵀJ of what was known with I, (q, q), of each, (n, q, q), and Jᵀe, (n + 1, q)."""
        q, simulator = self.model.q, Simulator(self.model, self.data)
        out, windows = np.zeros((self.n + 1, q, q)), self.windows.where(self.free)
        weights, owners = np.full(len(windows.rows), self.s**-2), self.owners[self.free] + 1
        linear = simulator.linear(self.p, windows, weights, owners=owners)
        out[: len(linear.parts)] = linear.parts
        slopes = np.zeros((self.n + 1, q))
        np.add.at(slopes, owners, linear.scores)
        slopes[0] -= self.p - self.model.prior
        for i in np.flatnonzero(~self.free):
            (first, last), start = self.windows.rows[i], self.windows.starts[i]
            _, S = simulator.slopes(self.p, first, last, start)
            R = S[:, self.model.structure.measured, :q] / (self.s * self.data.deviations[:, None])
            out[self.owners[i] + 1] = np.einsum("tnq,tnr->qr", R, R) if np.isfinite(R).all() else 0
        return np.eye(q) + out[0], out[1:], slopes


def _joined(a: Data, b: Data) -> Data:
    """Return the rows of both, with the deviations of the first."""
    n = len(a.time)
    time, measured, inputs = map(np.concatenate, zip(a[:3], b[:3], strict=True))
    ends = np.append(a.firsts, b.firsts + n), np.append(a.lasts, b.lasts + n)
    return Data(time, measured, inputs, *ends, a.deviations)
