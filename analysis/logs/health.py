"""Health of a log: sampling, and quantum, noise, range, limits and rest of each signal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.logs.excitation import Effect, effects, rates
from dopt.log import Log
from dopt.log_columns import TURN
from dopt.types import Array, Booleans, Vector

PERIODS = (1.0, TURN, 360.0, *(1000.0 * k for k in (1, 2, 2.4, 4, 8, 10)), *2.0 ** np.arange(8, 17))
"""Periods at which angles wrap: turns, radians, degrees and counts."""

DIGITS = 1e-7
"""Differences below this share of the largest value are rounding."""

FEW = 5
"""Levels below which a signal has no quantum: it is switched."""

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
    parts = [part[np.isfinite(part)] for part in parts]
    values = np.concatenate(parts)
    levels, counts = _levels(values)
    step = quantum(levels)
    floor = 0.0 if math.isnan(step) else step / math.sqrt(12.0)
    noise = max(floor, _fast(parts))
    crowd = max(3.0, 3.0 * float(np.median(counts)))
    at_low, at_high = (
        int(count) if count >= crowd and len(levels) > FEW else 0 for count in counts[[0, -1]]
    )
    low, high = float(levels[0]), float(levels[-1])
    rests = _rests(values, max(4.0 * noise, 0.01 * (high - low)))
    period = _wrap_period(parts, high - low)
    return Signal(name, low, high, len(levels), step, noise, at_low, at_high, period, rests)


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


def _rests(values: Vector, tolerance: float) -> Booleans:
    blocks = np.array_split(values, _BLOCKS)
    return np.array([block.size > 1 and np.ptp(block) <= tolerance for block in blocks])


def _wrap_period(parts: Sequence[Vector], span: float) -> float:
    """Return the period of jumps over more than half of the range, NaN without them."""
    steps = np.abs(np.concatenate([np.diff(part) for part in parts]))
    jumps = steps[steps > 0.5 * span]
    rest = steps[steps <= 0.5 * span]
    if not jumps.size or not rest.size or rest.max() > 0.3 * span or jumps.size > 0.2 * steps.size:
        return math.nan
    return float(min(PERIODS, key=lambda period: abs(math.log(span / period))))
