"""Rows of the benchmark table, speeds of others, and fixed work to compare machines by.

The speeds of others were measured on one core of a two-core machine in float64: cartpole, two
hidden layers of 16 units (386 parameters), D-optimal policy. The authors' figures belong to the
code that they released with the paper. Each says where and when it was measured, as far as kept.

Each section of the fixed work is as short as what is measured, and the quickest one counts: another
process interrupts long sections on a busy machine, short ones seldom. The work is never changed: a
history would lose its measure.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Target:
    """Value that is asked for.

    Attributes
    ----------
    number
        Of the target in the list of nine that the report explains.
    value
        Bound, in the unit of the row.
    at_least
        Whether larger is better.
    """

    number: int
    value: float
    at_least: bool = False

    def ratio(self, measured: float) -> float:
        """Return how many times better than the bound a value is; 1 meets it."""
        if self.at_least:
            return measured / self.value
        return self.value / measured if measured > 0 else float("inf")

    def text(self) -> str:
        return f"{'≥' if self.at_least else '≤'} {number(self.value)}"


@dataclass(frozen=True)
class Anchor:
    """Value of other people's code in the unit of the row, and where it comes from."""

    value: float
    source: str


TIMES = frozenset({"µs", "ms", "s", "min"})


@dataclass(frozen=True)
class Timing:
    """A time that the history keeps.

    Attributes
    ----------
    value, unit
        Quickest section, or CPU seconds, of what was measured; or a rate, whose unit ends in
        ``/s``.
    calibration
        Seconds of the quickest section of the fixed work beside it (:mod:`benchmarks.calibration`).
    """

    value: float
    unit: str
    calibration: float

    @property
    def cost(self) -> float:
        """Time in times of the fixed work, up to a factor that depends on the unit alone."""
        time = self.value if self.unit in TIMES else 1.0 / self.value
        return time / self.calibration


@dataclass(frozen=True)
class Row:
    """One line of the table; a value of None is a measurement that was left out, see ``note``.

    ``timing`` is what the history keeps, where that is more robust than the value.
    """

    what: str
    value: float | None
    unit: str = ""
    target: Target | None = None
    anchor: Anchor | None = None
    note: str = ""
    timing: Timing | None = None

    def cells(self) -> list[str]:
        """Return measured value, target, ratio to it, anchor, ratio to it and note as texts."""
        if self.value is None:
            return ["left out", *[""] * 4, self.note]
        target, anchor = self.target, self.anchor
        return [
            f"{number(self.value)} {self.unit}".strip(),
            f"{target.number}: {target.text()}" if target else "",
            f"{target.ratio(self.value):.2f}" if target else "",
            number(anchor.value) if anchor else "",
            number(anchor.value / self.value) if anchor else "",
            self.note,
        ]


def number(value: float) -> str:
    """Return a number with three significant digits or all of its whole ones."""
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def show(rows: Iterable[Row]) -> list[Row]:
    """Print each row as it is measured, and return all of them."""
    shown = []
    for row in rows:
        value = "left out" if row.value is None else f"{number(row.value)} {row.unit}"
        sys.stdout.write(f"{row.what}: {value.strip()}{f' ({row.note})' if row.note else ''}\n")
        sys.stdout.flush()
        shown.append(row)
    return shown


_AUTHORS = "authors' code, by 2026-11-21, processor not kept"
_LOCKSTEP = "torch.func, 100 trials in lockstep, by 2026-11-21, processor not kept"

STEP = Anchor(15_600, "authors' code, AMD EPYC (family 26, model 2), torch 2.13, 2026-11-27")
"""Plan, step, learn from a window of 100, update M⁻¹ [µs]."""

RANDOM_STEP = Anchor(550, _AUTHORS)
"""A step of the random policy that learns from one sample [µs]."""

EVALUATION = Anchor(870, _AUTHORS)
"""Evaluation on 8,000 points [µs]."""

LOCKSTEP = Anchor(342, _LOCKSTEP)
"""The step of :data:`STEP`, for each trial of the batch [µs]."""


SECTIONS = 40


def algebra() -> None:
    """Do dense algebra for some 0.2 ms, as the kernel does."""
    np.tanh(np.linalg.cholesky(_MATRIX @ _MATRIX.T + _IDENTITY))


def interpreter() -> None:
    """Run the interpreter for some 0.2 ms, as programs do."""
    counts: dict[int, int] = {}
    for i in range(3_000):
        counts[i % 97] = counts.get(i % 97, 0) + i


def fixed_seconds(work: Callable[[], None] = algebra) -> float:
    """Return the time of the quickest section."""
    return min(_timed(work) for _ in range(SECTIONS))


def _timed(work: Callable[[], None]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


_AT = np.linspace(0.0, 1.0, 128)
_IDENTITY = np.eye(128)
_MATRIX = np.exp(-8.0 * np.square(_AT[:, None] - _AT)) + _IDENTITY
