"""Health of a log: sampling, quantum, noise, limits and rest of signals, effects of the inputs."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dopt.log import Log, Piece
from dopt.log_columns import GAP, TURN
from dopt.types import Array, Booleans, Vector

LAGS = np.arange(-3, 9)
"""Samples by which the effect may come after the input."""

WINDOWS = (2, 4, 8, 16, 32)
"""Samples p to each side of the polynomials; the one in which most is explained is taken."""

MOST_ROWS = 100_000
"""Rows that are examined, the first ones of a longer log."""

FOLLOWS = 0.005
"""Share of an input's variance that the state leaves open, below which it follows the state."""

TOLD_APART = 1.15
"""Factor by which the next lags leave more unexplained, where a delay is told apart."""

OWN = 0.2
"""Share of an input's variance that the state leaves open, above which it varies on its own."""

STEADY = 4.5
"""Effect by its standard error, below which none is told apart."""

FEEDBACK = 0.05
"""Share of what an input's past leaves open that measurements explain, above which there is one."""

OF_INPUT = 0.002
"""Its least share of the input: a torque that was measured depends on the velocity a little."""

BETWEEN = 0.3
"""Share of what is left open between jumps, above which these hide the feedback, however small."""

PREDICTED, ROUNDED = 0.9999, 1.0 - 1e-9
"""Shares of an input that its past tells, above which feedback is not told apart, or a sure one."""

SURE = 0.9
"""Share of what is left open; of a regular input the motion, which is as regular, has up to .8."""

EXACT = 0.002
"""Share of its changes that measurements leave, below which a law, with a quantum, tells them."""

FAR = 7.5
"""Part of an input that its past leaves open, by its median, above which it jumps there."""

ENOUGH = 20
"""Rows for each fitted number in which an input moves, from which chance explains less of it."""

ROOM = 1.5
"""Windows side by side for each feature of the state, below which too little is left to tell."""

Response = tuple[float, int, Vector]
"""Steadiness, state and explained shares (lags,) of an input in one window."""

_LAG_BLOCKS = 16
_PAST = 10  # samples of an input's past
_TRIMMED = 6  # fits of it
_RATE = re.compile(r"vel|rate|omega|speed|dot|^q?d[a-z]?\d*$", re.IGNORECASE)


@dataclass(frozen=True)
class Effect:
    """Effect of one input on the motion.

    Attributes
    ----------
    input, state : str
        The input, and the position on which it shows most.
    explained : (lags,) array
        Share of the motion that the state leaves open that the input explains, by :data:`LAGS`.
    steadiness : float
        The effect at the best lag by its standard error over blocks of the log.
    delays : tuple of int, optional
        First and last lag that fit about as well as the best [samples]; None where more than
        three do.
    open : float
        Share of the input's variance that the state at the same time leaves open.
    feedback : float
        Share of what the input's own past leaves open that the measurements explain.
    predicted : float
        Share of the input that its own past tells.
    """

    input: str
    state: str
    explained: Vector
    steadiness: float
    delays: tuple[int, int] | None
    open: float
    feedback: float
    predicted: float

    @property
    def follows_state(self) -> bool:
        """Return whether the input is a function of the state."""
        return self.open < FOLLOWS

    @property
    def has_effect(self) -> bool:
        """Return whether an effect on the motion is told apart."""
        return not self.follows_state and self.steadiness >= STEADY

    @property
    def explains_nothing(self) -> bool:
        """Return whether it follows the state, or varies alone without an effect on the motion."""
        return self.follows_state or (self.open > OWN and not self.has_effect)

    @property
    def closed_loop(self) -> bool:
        """Return whether the input answers to the measurements."""
        is_large = self.feedback * (1.0 - self.predicted) > OF_INPUT
        feedback = self.feedback > (FEEDBACK if is_large else BETWEEN)
        most = ROUNDED if self.feedback > SURE else PREDICTED
        return self.follows_state or (feedback and self.predicted < most)

    @property
    def may_be_closed(self) -> bool:
        """Return whether feedback and an input as regular as the motion are not told apart."""
        return self.follows_state or (self.feedback > BETWEEN and not self.closed_loop)


def effects(log: Log) -> list[Effect]:
    """Return the effect of each input that varies; none where the pieces are too short."""
    pieces = list(_first_rows(log.pieces))
    are_rates = rates(log)
    found = []
    for j, name in enumerate(log.inputs):
        if all(np.ptp(piece.inputs[:, j]) == 0 for piece in pieces):
            continue
        kinds = [are_rates] if any(are_rates) else [are_rates, [True] * len(are_rates)]
        every = [
            [one for p in WINDOWS if (one := _best_response(pieces, kind, j, p)) is not None]
            for kind in kinds
        ]
        tried = max(every, key=_most)
        if tried:
            most = max(tried, key=lambda one: _most([one]))
            steadiness, i, explained = most
            law = _law(pieces, j)
            delays = None if law[0] < FOLLOWS else _delays(tried)
            found.append(Effect(name, log.states[i], explained, steadiness, delays, *law))
    return found


def _most(tried: Sequence[Response]) -> tuple[float, float]:
    """Return the largest share that is explained steadily, and the largest steadiness."""
    shares = [explained.max() for steadiness, _, explained in tried if steadiness >= STEADY]
    return max(shares, default=0.0), max((one[0] for one in tried), default=0.0)


def _delays(tried: Sequence[Response]) -> tuple[int, int] | None:
    """Return the lags of the narrowest window that tells them apart: wide ones blur them."""
    for steadiness, _, explained in tried:
        left = 1.0 - explained
        alike = np.flatnonzero(left <= TOLD_APART * left.min())
        inner = alike[0] > 0 and alike[-1] < len(LAGS) - 1
        if steadiness > STEADY and inner and np.ptp(alike) <= 2:
            return int(LAGS[alike[0]]), int(LAGS[alike[-1]])
    return None


def _first_rows(pieces: Sequence[Piece]) -> Iterator[Piece]:
    left = MOST_ROWS
    for piece in pieces:
        if left > 1:
            yield Piece(*(part[:left] for part in piece))
        left -= len(piece.time)


def weights(p: int, derivative: int) -> Vector:
    """Return the weights (2 p + 1,) of a derivative of the cubic through samples, by sample."""
    powers = np.vander(np.arange(-p, p + 1.0), 4, increasing=True)
    found: Vector = np.linalg.pinv(powers)[derivative] * (1, 1, 2)[derivative]
    return found


def rates(log: Log) -> list[bool]:
    """Return which states are rates: by their names, or as they follow another one's slope."""
    n, p = len(log.states), 8
    found = [bool(_RATE.search(name)) for name in log.states]
    pieces = _first_rows(log.pieces)
    longest = max(pieces, key=lambda piece: len(piece.time)).measured
    if len(longest) <= 4 * p:
        return found
    smooth, slopes = (_filtered(longest, weights(p, order)) for order in (0, 1))
    there = np.isfinite(smooth).all(axis=1)
    for i in range(n if there.any() else 0):
        for j in range(n):
            if i != j and np.ptp(smooth[there, j]) > 0 and np.ptp(slopes[there, i]) > 0:
                alike = np.corrcoef(slopes[there, i], smooth[there, j])[0, 1]
                found[j] |= bool(alike > 0.9)
    return found


def _filtered(values: Array, weight: Vector) -> Array:
    """Return the weighted sums about each row that has all of them, (rows, columns)."""
    return np.column_stack([np.convolve(one, weight[::-1], "valid") for one in values.T])


def _best_response(
    pieces: Sequence[Piece], are_rates: Sequence[bool], j: int, p: int
) -> Response | None:
    """Return steadiness, state and explained shares by lag of one input."""
    only_rates = all(are_rates)
    used = [i for i, rate in enumerate(are_rates) if only_rates or not rate]
    rows = [
        _rows(piece, used, only_rates, p)
        for piece in pieces
        if len(piece.time) > 4 * p + len(LAGS) + 8
    ]
    if not rows:
        return None
    state, motion, lagged = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    x = lagged[:, :, j]
    if not len(state):
        return None
    others = [k for k in range(lagged.shape[2]) if k != j and not _alike(lagged[:, 3, [j, k]])]
    features = np.column_stack([state, lagged[:, 3, others]])
    if len(state) < ROOM * (2 * p + 1) * features.shape[1]:
        return None
    basis = _basis(features)
    x_left = x - basis @ (basis.T @ x)
    power = (x_left**2).sum(axis=0)
    total = float(((x - x.mean(axis=0)) ** 2).sum(axis=0).mean())
    if total == 0 or power.min() <= 1e-14 * total:
        return None if total == 0 else (0.0, used[0], np.zeros(len(LAGS)))
    left = motion - basis @ (basis.T @ motion)
    unexplained = np.maximum((left**2).sum(axis=0), 1e-300)
    explained = (x_left.T @ left) ** 2 / power[:, None] / unexplained  # (lags, states)
    lag, place = np.unravel_index(int(explained.argmax()), explained.shape)
    steadiness = _steadiness(x_left[:, lag], left[:, place])
    return steadiness, used[int(place)], explained[:, place]


def _alike(two: Array) -> bool:
    """Return whether two inputs, (rows, 2), are the same apart from noise."""
    one, other = two.T
    still = np.ptp(one) == 0 or np.ptp(other) == 0
    return bool(still or abs(np.corrcoef(one, other)[0, 1]) > 0.9)


def _rows(
    piece: Piece, used: Sequence[int], only_rates: bool, p: int
) -> tuple[Array, Array, Array]:
    """Return features of the state, accelerations, and averaged inputs at all lags, by row."""
    measured, margin = piece.measured[:, used], int(np.abs(LAGS).max()) + 1
    value, slope, bend = (
        _filtered(measured, weights(p, order))[margin:-margin] for order in (0, 1, 2)
    )
    features: list[Any] = [np.ones(len(value)), value, value**2, np.sin(value), np.cos(value)]
    if only_rates:
        features += [np.sign(value), value * np.abs(value)]
    else:
        size = np.abs(slope)
        features += [slope, np.sign(slope), slope * size]
        features += [slope * np.sin(value), slope * np.cos(value)]
        i, k = np.triu_indices(len(used), 1)  # coupled links
        turned = value[:, i] - value[:, k]
        features += [np.sin(turned), np.cos(turned)]
    if only_rates:
        motion, held = slope, piece.inputs
        kernel = -np.cumsum(weights(p, 1))[:-1]
    else:
        motion = bend
        held = np.vstack([piece.inputs[:1], (piece.inputs[1:] + piece.inputs[:-1]) / 2])
        kernel = np.cumsum(np.cumsum(weights(p, 2)))[:-2]
    averaged = _filtered(held, kernel)
    first = p + margin - (p if only_rates else p - 1)  # its row of the first lag 0
    n = len(value)
    lagged = np.stack([averaged[first - lag : first - lag + n] for lag in LAGS], axis=1)
    table = np.column_stack(features)
    there = np.isfinite(table).all(axis=1) & np.isfinite(motion).all(axis=1)
    return table[there], motion[there], lagged[there]


def _basis(features: Array) -> Array:
    """Return an orthonormal basis of what features span, (rows, rank)."""
    scaled = features / np.maximum(np.sqrt((features**2).mean(axis=0)), 1e-300)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    kept = values > 1e-11 * values[-1]
    basis: Array = np.linalg.qr(scaled @ vectors[:, kept])[0]
    return basis


def _steadiness(x: Vector, motion: Vector) -> float:
    """Return the slope of the motion over the input by its standard error, from blocks of rows."""
    slope = float(x @ motion) / float(x @ x)
    scores = x * (motion - slope * x)
    sums = np.array([part.sum() for part in np.array_split(scores, _LAG_BLOCKS)])
    error = float(np.sqrt((sums**2).sum())) / float(x @ x)
    return abs(slope) / max(error, 1e-300)


def _law(pieces: Sequence[Piece], j: int) -> tuple[float, float, float]:
    """Return what the state leaves open of an input, what it adds to its past, and the past.

    Rows in which the input stays as it is, such as at a limit, tell of no feedback, and its jumps,
    such as at steps of a set point, may hide what is fed back between them. The last two are of the
    rows in which it moves, and of these between jumps where much is. Where a quantum hides what a
    measurement adds to the past, changes over several rows still follow a law.
    """
    rows = [_causal(piece, j) for piece in pieces if len(piece.time) > 4 * _PAST]
    if not rows:
        return 1.0, 0.0, 0.0
    now, past, seen = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    numbers = past.shape[1] + seen.shape[1]
    if len(now) < 4 * numbers:
        return 1.0, 0.0, 0.0
    left = _left(np.column_stack([past[:, 0], seen]), now)[0]
    share = left / float(((now - now.mean()) ** 2).sum())
    moves = now != past[:, 1 + j]
    if moves.sum() >= ENOUGH * numbers:
        now, past, seen = now[moves], past[moves], seen[moves]
    usual = _usual(past, now)
    between = _feedback(past[usual], seen[usual], now[usual])
    found = between if between[0] > BETWEEN else _feedback(past, seen, now)
    if found[0] < FEEDBACK and unexplained_changes(pieces, j) < EXACT:
        return share, 1.0, 1.0
    return share, *found


def unexplained_changes(pieces: Sequence[Piece], j: int) -> float:
    """Return the share of an input's changes, without jumps, that measured changes leave open."""
    seen, changes = (
        np.concatenate([part[_PAST:] - part[:-_PAST] for part in parts])
        for parts in ([one.measured for one in pieces], [one.inputs[:, j] for one in pieces])
    )
    there = np.isfinite(seen).all(axis=1) & seen.any(axis=1)  # it moves by a quantum
    usual = _usual(seen[there], changes[there])
    changes, seen = changes[there][usual], seen[there][usual]
    total = float(changes @ changes)
    return _left(seen, changes)[0] / total if total > 0.0 and usual.mean() > 0.5 else 1.0


def _feedback(past: Array, seen: Array, now: Vector) -> tuple[float, float]:
    """Return what measurements explain of what the past leaves open, and what the past tells."""
    total = float(((now - now.mean()) ** 2).sum())
    alone, n_alone = _left(past, now)
    if alone <= 1e-12 * total:
        return 0.0, 1.0
    both, n_both = _left(np.column_stack([past, seen]), now)
    ratio = (both / (len(now) - n_both)) / (alone / (len(now) - n_alone))
    return max(0.0, 1.0 - ratio), 1.0 - alone / total


def _causal(piece: Piece, j: int) -> tuple[Vector, Array, Array]:
    """Return an input, the past of all inputs, and measurements up to the same row, by row."""
    n = len(piece.time)

    def back(values: Array, lag: int) -> Array:
        return values[_PAST - lag : n - lag]

    now = back(piece.inputs[:, j], 0)
    past = np.column_stack(
        [np.ones(len(now)), *(back(piece.inputs, lag) for lag in range(1, _PAST + 1))]
    )
    state = back(piece.measured, 0)
    recent = [back(piece.measured, lag) for lag in range(4)]
    seen = np.column_stack([*recent, np.sin(state), np.cos(state)])
    there = np.isfinite(seen).all(axis=1)
    return now[there], past[there], seen[there]


def _usual(features: Array, values: Vector) -> Booleans:
    """Return the rows that features tell about as well as they tell most of these rows."""
    kept = np.ones(len(values), np.bool_)
    for _ in range(_TRIMMED):
        told = np.linalg.lstsq(features[kept], values[kept], rcond=1e-12)[0]
        rest = np.abs(values - features @ told)
        far = rest > FAR * np.median(rest[kept]) + 1e-12 * np.abs(values).max()
        if (far != kept).all():
            break
        kept = ~far
    return kept


def _left(features: Array, values: Vector) -> tuple[float, int]:
    """Return the sum of squares that features leave, and how many numbers were fitted."""
    basis = _basis(features)
    rest = values - basis @ (basis.T @ values)
    return float(rest @ rest), basis.shape[1]


PERIODS = (1.0, TURN, 360.0, *1e3 * np.array((1, 2, 2.4, 4, 8, 10)), *2.0 ** np.r_[8:17, 32])
"""Periods at which angles wrap: turns, radians, degrees and counts."""

DIGITS = 1e-7
"""Differences below this share of the largest value are rounding."""

FEW = 5
"""Levels below which a signal has no quantum: it is switched."""

MANY = 20
"""Levels beside which one that is far from all may stand for a missing measurement."""

_BLOCKS = 100  # of a log, in which a signal may rest


@dataclass(frozen=True)
class Signal:
    """Facts of one state or input, in its unit.

    Attributes
    ----------
    name : str
    low, high : float
        Range.
    levels : int
        Different values, apart from rounding.
    quantum : float
        Smallest step, NaN for a signal without steps.
    noise : float
        Standard deviation of what is fast, at most; at least quantum/√12.
    at_low, at_high : int
        Rows at an end of the range, where these are more than elsewhere; 0 otherwise.
    period : float
        Period at which it wraps, NaN for none.
    rests : (100,) array
        Whether it rests in each hundredth of the log.
    alone : (float, int), optional
        A value far from all others, and its rows, which the other facts leave out.
    """

    name: str
    low: float
    high: float
    levels: int
    quantum: float
    noise: float
    at_low: int
    at_high: int
    period: float
    rests: Booleans
    alone: tuple[float, int] | None


@dataclass(frozen=True)
class Health:
    """Facts of a log: its signals, effects of its inputs, steps [s], and where nothing moves.

    ``irregular`` is the share of steps more than 20 % off the median, ``resting`` (100,) whether
    all positions rest in each hundredth of the log.
    """

    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    effects: tuple[Effect, ...]
    step: float
    shortest: float
    longest: float
    irregular: float
    resting: Booleans


def examine(log: Log) -> Health:
    """Return the health of a log."""
    steps = np.concatenate([np.diff(piece.time) for piece in log.pieces])
    far = np.abs(steps / np.median(steps) - 1.0) > 0.2
    states, inputs = (
        tuple(
            _signal(name, [getattr(piece, what)[:, i] for piece in log.pieces])
            for i, name in enumerate(names)
        )
        for what, names in (("measured", log.states), ("inputs", log.inputs))
    )
    are_rates = rates(log)
    moving = [
        one for one, rate in zip(states, are_rates, strict=True) if not rate or all(are_rates)
    ]
    return Health(
        states,
        inputs,
        tuple(effects(log)),
        float(np.median(steps)),
        float(steps.min()),
        float(steps.max()),
        float(far.mean()),
        np.all([one.rests for one in moving], axis=0),
    )


def _signal(name: str, parts: Sequence[Vector]) -> Signal:
    parts = [run for part in parts for run in _runs(part)]
    values = np.concatenate(parts)
    levels, counts = _levels(values)
    alone, without = _alone(levels, counts)
    if alone is not None:
        parts = [part[~np.isclose(part, alone[0], rtol=DIGITS, atol=0)] for part in parts]
        values, (levels, counts) = np.concatenate(parts), without
    step = quantum(levels)
    floor = 0.0 if math.isnan(step) else step / math.sqrt(12.0)
    noise = max(floor, _fast(parts))
    crowd = max(3.0, 3.0 * float(np.median(counts)))
    at_low, at_high = (
        int(count) if count >= crowd and len(levels) > FEW else 0 for count in counts[[0, -1]]
    )
    low, high = float(levels[0]), float(levels[-1])
    rests = _rests(values, 4.0 * noise)
    period = _wrap_period(parts, high - low)
    facts = (len(levels), step, noise, at_low, at_high, period, rests, alone)
    return Signal(name, low, high, *facts)


def _runs(values: Vector) -> list[Vector]:
    """Return measured values, in parts where many in a row are missing."""
    rows = np.flatnonzero(np.isfinite(values))
    steps = np.diff(rows, prepend=rows[:1])
    longest = GAP * float(np.median(steps)) if rows.size else 0.0
    return np.split(values[rows], np.flatnonzero(steps > max(longest, GAP)))


def _alone(levels: Vector, counts: Array) -> tuple[tuple[float, int] | None, tuple[Vector, Array]]:
    """Return a value beyond all others by more than their range, its rows, and the other levels."""
    for at, rest in ((0, slice(1, None)), (-1, slice(-1))):
        others = levels[rest]
        if len(others) > MANY and np.abs(others - levels[at]).min() > np.ptp(others):
            return (float(levels[at]), int(counts[at])), (others, counts[rest])
    return None, (levels, counts)


def _levels(values: Vector) -> tuple[Vector, Array]:
    """Return the different values apart from rounding, and how often each is taken."""
    levels, counts = np.unique(values, return_counts=True)
    apart = np.diff(levels, prepend=-np.inf) > DIGITS * float(np.abs(levels).max())
    return levels[apart], np.add.reduceat(counts, np.flatnonzero(apart))


def quantum(levels: Vector) -> float:
    """Return the step of which all steps between sorted levels are multiples, NaN for none.

    Levels that were never taken do no harm, nor do a few levels in a hundred off the grid.
    """
    if len(levels) < FEW:
        return math.nan
    steps = np.diff(levels)
    for base in np.quantile(steps, (0.0, 0.01, 0.05, 0.25, 0.5), method="lower"):
        for part in (1, 2, 3):
            step = base / part
            for most in (10, math.inf):  # the near ones first, whose multiples are sure
                multiples = np.round(steps / step)
                near = (multiples > 0) & (multiples <= most)
                if near.any():
                    step = steps[near].sum() / multiples[near].sum()
            off = np.abs(steps / step - np.round(steps / step))
            if (off < 0.1).mean() >= 0.98:
                return float(step)
    return math.nan


def _fast(parts: Sequence[Vector]) -> float:
    """Return the standard deviation of what cubics and smoother motion do not follow, at most."""
    found = []
    for order in (2, 3, 4):
        left = np.concatenate([np.diff(part, order) for part in parts])
        if left.size:
            spread = 1.4826 * float(np.median(np.abs(left)))
            found.append(spread / math.sqrt(math.comb(2 * order, order)))
    return min(found, default=0.0)


def _rests(values: Vector, noise: float) -> Booleans:
    """Return where a signal moves by no more than noise, 1 % of its range and 2 % of its most."""
    blocks = [block for block in np.array_split(values, _BLOCKS) if block.size > 1]
    moved = np.array([np.ptp(block) for block in blocks])
    resting = moved <= max(noise, min(0.01 * np.ptp(values), 0.02 * moved.max(initial=0.0)))
    return np.concatenate([resting, np.zeros(_BLOCKS - len(blocks), bool)])


def _wrap_period(parts: Sequence[Vector], span: float) -> float:
    """Return the period of jumps over more than half of the range, NaN without them."""
    steps = np.abs(np.concatenate([np.diff(part) for part in parts]))
    jumps = steps[steps > 0.5 * span]
    rest = steps[steps <= 0.5 * span]
    if not jumps.size or not rest.size or rest.max() > 0.3 * span or jumps.size > 0.2 * steps.size:
        return math.nan
    return float(min(PERIODS, key=lambda period: abs(math.log(span / period))))
