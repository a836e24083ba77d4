"""Recorded runs of a plant: columns of a table as pieces without gaps, in the units of the plant.

Nothing is resampled, filtered or differentiated. What is left out or converted is said in the
notes of a :class:`Log`. Rows are counted from 0.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from dopt.errors import SpecificationError, counted, suggestion, unknown_name
from dopt.log_columns import (
    GAP,
    TURN,
    clock_column,
    clock_unit,
    clocks_of,
    columns_of,
    continued,
    rows_text,
    stamps_of,
    values_of,
)
from dopt.types import Array, Booleans, Integers

if TYPE_CHECKING:
    from dopt.systems.plant import Plant

_ONE_TURN = TURN * 1.01  # a wrapped angle with its noise

NEAR, MOST_OUTLIERS = 31, 0.02
"""Values that say what is usual, and the share of all from which there are no outliers."""

Rows = Sequence[npt.NDArray[np.intp]]


class Piece(NamedTuple):
    """A stretch of a log without gaps.

    Attributes
    ----------
    time : (N,) array
        Stamps, strictly increasing [s].
    measured : (N, n) array
        Measured states, NaN where a value is missing. Angles are unwrapped.
    inputs : (N, m) array
        Inputs; the input of row k is held from ``time[k]`` to ``time[k + 1]``.
    """

    time: Array
    measured: Array
    inputs: Array


class Log:
    """A recorded run: measured states and inputs over time, in pieces without gaps.

    >>> log = dopt.Log(
    ...     frame,
    ...     states={"angle": "th"},
    ...     inputs={"voltage": "u"},
    ...     time="stamp",
    ...     angles=["angle"],
    ...     units={"stamp": "ms", "th": "counts/4096"},
    ... )

    - A row that repeats the stamp of the row before it is left out.
    - A row with an earlier stamp is left out if the row after it goes on behind the row before it;
      otherwise the clock was started again, and a new piece begins.
    - A counter of 32 or 16 bits that begins again goes on.
    - A piece ends before a row without time or input, and at a gap.
    - A missing measurement stays missing: its row is kept. So does one that one or two rows long is
      far from those around it, by what is usual there: an outlier, also of whole turns.
    - An angle measured within one turn is unwrapped; one that counts turns is kept.
    - A state without a column is left out of ``states``: a fit estimates it.

    Parameters
    ----------
    data : DataFrame, mapping of str to array, or (rows, columns) array
        The table. Whole numbers and truth values are numbers; so is text that reads as one.
    states, inputs : sequence of str, or mapping of str to str
        Names of the n measured states and the m inputs; with the names of their columns, where
        these differ.
    time : str or array, optional
        Column of the stamps, or the stamps: numbers, dates or spans of time. Without it, a column
        called time, t, timestamp or Zeit is taken, with a unit or without: ``time_ms``, ``t [s]``,
        or the only one of dates, such as the index of a DataFrame.
        Times count from the first stamp.
    dt : float, optional
        Time between two rows [s] of a table without stamps.
    angles : sequence of str
        Measured states that are angles, in radians after ``units``.
    gap : float, optional
        Longest step within a piece [s]; 10 times the median step, unless it is given.
    units : mapping of str to str or float, optional
        Units of columns that are not as the plant has them, by state, input, column or "time":
        "deg", "rev", "rpm", "mrad", "counts/4096" (counts a turn), each also by "/s"; "ms", "us",
        "ns", "min" or "h" of stamps; or a factor.
    columns : sequence of str, optional
        Names of the columns of an array.

    Attributes
    ----------
    states, inputs : tuple of str
        Names of the measured states and of the inputs, in the order of the columns of a piece.
    pieces : tuple of Piece
        Stretches without gaps, of two rows or more.
    notes : tuple of str
        One sentence for each thing that was done or found.
    left_out : tuple of (N, n) arrays
        Which measurements of each piece were left out as outliers.

    Raises
    ------
    SpecificationError
        If a column is missing, is no column of numbers, or no two rows can be used.
    """

    def __init__(
        self,
        data: Any,
        *,
        states: Sequence[str] | Mapping[str, str],
        inputs: Sequence[str] | Mapping[str, str],
        time: str | npt.ArrayLike | None = None,
        dt: float | None = None,
        angles: Sequence[str] = (),
        gap: float | None = None,
        units: Mapping[str, str | float] | None = None,
        columns: Sequence[str] | None = None,
    ) -> None:
        table, notes = columns_of(data, columns), list[str]()
        named = [_chosen("states", states, table), _chosen("inputs", inputs, table)]
        self.states, self.inputs = (tuple(found) for found in named)
        angles = [angles] if isinstance(angles, str) else list(angles)
        for name in angles:
            if name not in self.states:
                raise unknown_name("measured state in 'angles' of a log", name, self.states)
        taken = {column for group in named for column in group.values()}
        clock = clock_column(table, taken, time, dt, notes)
        unit_of = _units_of(units or {}, named, clock)
        unit = unit_of.get(clock or "time", clock_unit(clock or "") or 1.0)
        stamps = stamps_of(table, clock, time, dt, unit, notes)
        measured, applied = (
            np.column_stack([values_of(one, table[one], unit_of, notes) for one in found.values()])
            for found in named
        )
        _note_missing(self.states, measured, notes)
        usable = np.isfinite(stamps) & np.isfinite(applied).all(axis=1)
        rows = _without_gaps(stamps, usable, gap, notes)
        lost = np.zeros(measured.shape, np.bool_)
        for i, name in enumerate(self.states):
            if name in angles:
                lost[_leave_out(name, measured[:, i], rows, TURN, notes), i] = True
                measured[:, i] = _unwrapped(name, measured[:, i], rows, notes)
            lost[_leave_out(name, measured[:, i], rows, math.inf, notes), i] = True
        self.left_out = tuple(lost[k] for k in rows)
        start = stamps[rows[0][0]]
        if start:
            notes.append(f"Times count from the first usable stamp, {start:.10g} s.")
        self.pieces = tuple(Piece(stamps[k] - start, measured[k], applied[k]) for k in rows)
        self.notes = tuple(notes)

    @classmethod
    def for_plant(
        cls,
        data: Any,
        plant: Plant,
        columns: Mapping[str, str] | Sequence[str] | None = None,
        *,
        time: str | npt.ArrayLike | None = None,
        dt: float | None = None,
        **options: Any,
    ) -> Log:
        """Return the log of a plant, whose states, inputs and angles have their names there.

        Parameters
        ----------
        data, time, dt : optional
            As of :class:`Log`; rows without stamps are ``plant.dt`` apart.
        plant : Plant
            Its measured states and its inputs have to have columns. If it names no measured
            states, those that have a column are measured.
        columns : mapping of str to str, or sequence of str
            Column of each state and input that has another name in the table; or the names of the
            columns of an array.
        **options
            ``gap`` and ``units`` of :class:`Log`.
        """
        renamed, names = (columns, None) if isinstance(columns, Mapping) else ({}, columns)
        table, both = columns_of(data, names), {**plant.states, **plant.inputs}
        for name in renamed:
            if name not in both:
                raise unknown_name("state or input in 'columns' of a log", name, both)
        found = {name: renamed.get(name, name) for name in plant.measured or plant.states}
        if not plant.measured:
            found = {name: one for name, one in found.items() if one in table or name in renamed}
        if not found:
            raise SpecificationError(
                f"a log has the columns {', '.join(table)}, but none is named like a state of the "
                f"plant ({', '.join(plant.states)}): give columns={{state: column}}."
            )
        notes = []
        taken = {*found.values(), *(renamed.get(name, name) for name in plant.inputs)}
        if time is None and dt is None and not clocks_of(table, taken):
            dt = float(plant.dt)
            notes.append(
                f"No column of stamps (--time): rows are the plant's dt of {dt:g} s apart."
            )
        log = cls(
            table,
            states=found,
            inputs={name: renamed.get(name, name) for name in plant.inputs},
            **{"time": time, "dt": dt, **options},
            angles=[name for name in plant.angles if name in found],
        )
        unmeasured = [name for name in plant.states if name not in found]
        if unmeasured:
            notes.append(f"Without a column, left to the fit: {', '.join(unmeasured)}.")
        log.notes = (*notes, *log.notes)
        return log

    @classmethod
    def of_pieces(
        cls, states: Sequence[str], inputs: Sequence[str], pieces: Sequence[Piece]
    ) -> Log:
        """Return the log of pieces that are as :class:`Piece` describes."""
        log = cls.__new__(cls)
        log.states, log.inputs = tuple(states), tuple(inputs)
        log.pieces, log.notes = tuple(pieces), ()
        log.left_out = tuple(np.zeros(piece.measured.shape, np.bool_) for piece in pieces)
        return log

    @property
    def outliers(self) -> Counter[str]:
        """Measurements that were left out as outliers, by state."""
        counts = np.sum([lost.sum(axis=0) for lost in self.left_out], axis=0)
        return Counter(dict(zip(self.states, counts.tolist(), strict=True)))

    @property
    def n_rows(self) -> int:
        """Rows of all pieces."""
        return sum(len(piece.time) for piece in self.pieces)

    @property
    def step(self) -> float:
        """Median time between two rows [s]."""
        return float(np.median(np.concatenate([np.diff(piece.time) for piece in self.pieces])))

    def __repr__(self) -> str:
        duration = sum(float(piece.time[-1] - piece.time[0]) for piece in self.pieces)
        return (
            f"Log({self.n_rows:,} rows, {counted(len(self.pieces), 'piece')}, {duration:g} s, "
            f"states {', '.join(self.states)}, inputs {', '.join(self.inputs)})"
        )


def _chosen(what: str, given: Any, table: Mapping[str, npt.NDArray[Any]]) -> dict[str, str]:
    """Return names with their columns, or say which columns there are not and which there are."""
    names = [given] if isinstance(given, str) else list(given)
    found = {name: given[name] if isinstance(given, Mapping) else name for name in names}
    if not names or len(found) < len(names):
        raise SpecificationError(
            f"the {what} of a log are {names}, but one or more names that differ are expected: "
            f"correct them."
        )
    missing = [column for column in found.values() if column not in table]
    if missing:
        raise SpecificationError(
            f"the {what} of a log are to be read from {', '.join(map(repr, missing))}, but no such "
            f"column is there: {suggestion(str(missing[0]), table)}"
        )
    return found


def _units_of(
    units: Mapping[str, str | float], named: Sequence[Mapping[str, str]], clock: str | None
) -> dict[str, str | float]:
    """Return the unit of each column that has one, by the name of the column."""
    places = {name: column for group in named for name, column in group.items()}
    places |= {column: column for column in places.values()}
    places |= {"time": clock or "time", clock or "time": clock or "time"}
    for name in units:
        if name not in places:
            raise unknown_name("column in 'units' of a log", name, places)
    return {places[name]: unit for name, unit in units.items()}


def _without_gaps(t: Array, usable: Booleans, gap: float | None, notes: list[str]) -> Rows:
    """Return the rows of each piece, two at least."""
    if gap is not None and not gap > 0:
        raise SpecificationError(
            f"gap of a log is {gap!r}, but a positive number of seconds is expected: correct it."
        )
    rows = np.flatnonzero(usable)
    if rows.size < t.size:
        lost = np.flatnonzero(~usable)
        notes.append(f"Without time or input, not used, pieces end there: {rows_text(lost)}.")
    begins = np.diff(rows, prepend=-2) > 1  # a piece begins
    again = (np.diff(t[rows], prepend=np.nan) == 0) & ~begins
    if 2 * int(again.sum()) > again.size:
        raise SpecificationError(
            f"{int(again.sum()):,} of {again.size:,} rows of a log repeat the stamp of the row "
            f"before them, but a stamp for each row is expected: give stamps with more digits, or "
            f"the time between two rows as dt."
        )
    if again.any():
        notes.append(f"Stamp of the row before repeated, left out: {rows_text(rows[again])}.")
    rows, begins = rows[~again], begins[~again]
    late, stamps = np.zeros(rows.size, np.bool_), t[rows]  # which the next one passes
    late[1:-1] = (stamps[1:-1] < stamps[:-2]) & (stamps[2:] > stamps[:-2])
    late[1:-1] &= ~begins[1:-1] & ~begins[2:]
    if late.any():
        notes.append(f"Out of order, left out: {rows_text(rows[late])}.")
    rows, begins = rows[~late], begins[~late]
    steps = np.diff(t[rows], prepend=np.nan)
    back = (steps < 0) & ~begins
    if back.any():
        notes.append(f"The clock runs backwards, new pieces begin: {rows_text(rows[back])}.")
    begins |= back
    if not begins.all():
        median = float(np.median(steps[~begins]))
        longest = GAP * median if gap is None else gap
        far = (steps > longest) & ~begins
        if far.any():
            notes.append(
                f"Steps longer than {longest:.4g} s (the median is {median:.4g} s), new pieces "
                f"begin: {rows_text(rows[far])}."
            )
        begins |= far
    pieces = np.split(rows, np.flatnonzero(begins)[1:])
    alone = [piece for piece in pieces if len(piece) == 1]
    if len(alone) == len(pieces) or not rows.size:
        held = "fill the inputs where they were held (in pandas: ffill()), or give a longer gap."
        raise SpecificationError(
            f"no two of the {t.size} rows of a log follow each other with a time, inputs and no "
            f"gap, but a piece of two rows is expected: "
            + ("sort the rows by time." if 2 * int(back.sum()) > rows.size else held)
        )
    if alone:
        notes.append(f"Alone between two gaps, left out: {rows_text(np.concatenate(alone))}.")
    return [piece for piece in pieces if len(piece) > 1]


def _unwrapped(name: str, angle: Array, pieces: Rows, notes: list[str]) -> Array:
    """Return an angle that is followed over the ends of a turn within each piece."""
    used = angle[np.concatenate(pieces)]
    used = used[np.isfinite(used)]
    span = float(np.ptp(np.quantile(used, (0.01, 0.99)))) if used.size else 0.0  # but glitches
    if span > _ONE_TURN:
        notes.append(f"Angle {name!r} counts turns ({span / TURN:.3g} of them): it is kept.")
        return angle
    found, passes = angle.copy(), 0
    for rows in pieces:
        found[rows] = continued(angle[rows], TURN)
        moved = np.round((found[rows] - angle[rows])[np.isfinite(angle[rows])] / TURN)
        passes += int(np.count_nonzero(np.diff(moved)))
    if passes:
        notes.append(
            f"Angle {name!r} is measured within one turn and passes its end "
            f"{counted(passes, 'time')}: unwrapped."
        )
    return found


def _leave_out(name: str, y: Array, pieces: Rows, period: float, notes: list[str]) -> Integers:
    """Write NaN in the place of the outliers of a measured state, and return their rows."""
    there = [each[np.isfinite(y[each])] for each in pieces]
    found = [each[outliers(y[each], period)] for each in there if len(each) >= NEAR]
    rows = np.concatenate([*found, np.empty(0, np.intp)])
    if not 0 < len(rows) <= MOST_OUTLIERS * len(y):
        return rows[:0]
    notes.append(f"{counted(len(rows), 'outlier')} of {name} left out, first row {rows[0]}.")
    y[rows] = np.nan
    return rows


def outliers(y: Array, period: float) -> Booleans:
    """Return which of finite values, (N,), are far from most of the five around them.

    Far is beyond the way from those before to those after, and beyond 10 times the median second
    difference near, 1.5 times the median first one, which an end stop turns, and 1.5 times the
    median change of the whole. Differences are taken within half a period.
    """

    def turned(change: Array) -> Array:
        return change - (period * np.round(change / period) if period < math.inf else 0.0)

    def around(part: Array, width: int) -> Array:
        return sliding_window_view(np.pad(part, width // 2, mode="edge"), width)

    first = turned(np.diff(y, prepend=y[0]))
    usual: Array = np.full(
        len(y), np.median(1.5 * np.abs(first[first != 0.0])) if first.any() else 0
    )
    for change, factor in ((turned(np.diff(first, append=first[-1])), 10.0), (first, 1.5)):
        usual = usual + factor * np.median(around(np.abs(change), NEAR), axis=1)
    near = around(y, 5)
    across = np.abs(turned(near[:, 3:, None] - near[:, None, :2])).min(axis=(1, 2))
    apart = np.median(np.abs(turned(near - y[:, None])), axis=1)
    return np.asarray(apart > np.maximum(usual, across))


def _note_missing(names: Sequence[str], measured: Array, notes: list[str]) -> None:
    for name, values in zip(names, measured.T, strict=True):
        lost = int(np.isnan(values).sum())
        if lost == len(values):
            raise SpecificationError(
                f"measured state {name!r} of a log has no value at all, but some numbers are "
                f"expected: leave it out of 'states', then a fit estimates it."
            )
        if lost:
            notes.append(f"State {name!r} is missing in {counted(lost, 'row')}: it stays missing.")
