"""Recorded runs of a plant: columns of a table as pieces without gaps, in the units of the plant.

Nothing is resampled, filtered or differentiated. What is left out or converted is said in the
notes of a :class:`Log`. Rows are counted from 0.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError, suggestion, unknown_name
from dopt.outliers import MOST_OUTLIERS, NEAR, outliers
from dopt.types import Array, Booleans, Integers

if TYPE_CHECKING:
    from dopt.systems.plant import Plant

GAP = 10.0
"""Median steps after which a step is a gap, unless ``gap`` is given."""

TURN = 2.0 * math.pi

UNITS = {"rad": 1.0, "mrad": 1e-3, "deg": TURN / 360, "rev": TURN, "turn": TURN, "rpm": TURN / 60}
"""Units of angles, and what they are in radians; ``/s`` may follow, and ``counts/4096`` is one."""

SECONDS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
SECONDS |= {"min": 60.0, "h": 3600.0}
"""Units of time [s]."""

_CLOCK = re.compile(
    r"(?!(?-i:T)_|.*_(?:min|h)$)(?:time|t|timestamp|zeit)"  # no temperature, no minimum
    rf"(?:(?:\s*[\[(/]|\s+in|_|\s)\s*({'|'.join(SECONDS)})\s*[\])]?)?",
    re.IGNORECASE,
)
UNIT_OF_ANGLE = re.compile(r"[\[(/_ ](deg(?:/s)?|mrad(?:/s)?|rpm)[\])]?$", re.IGNORECASE)

_ROLL_OVERS = (2.0**32 * 1e-6, 2.0**32 * 1e-3)
"""Times after which a 32-bit counter of µs or ms begins again [s]."""

_MISSING = ("", "na", "nan", "nat", "<na>", "n/a", "none", "null")

_DATE = re.compile(
    r"(\d{4}-[01]\d-[0-3]\d(?:[ T][0-2]\d:[0-5]\d(?::[0-5]\d(?:[.,]\d+)?)?)?) ?(Z|[-+]\d\d:?\d*)?"
)


def clock_unit(name: str) -> str | None:
    """Return the unit in the name of a clock, "" in ``run.t``; None of what is called otherwise."""
    found = _CLOCK.fullmatch(name.strip().rsplit(".", 1)[-1])
    return found and (found[1] or "").lower()


def columns_of(data: Any, names: Sequence[str] | None = None) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of a table by name, each of the shape (rows,), as they are given.

    Raises
    ------
    SpecificationError
        If they differ in length, are no columns, or have no names.
    """
    if names is not None:
        array = np.asanyarray(data)
        if array.ndim != 2 or array.shape[1] != len(names):
            raise SpecificationError(
                f"a log has an array of the shape {array.shape} and {len(names)} names in "
                f"'columns', but one name for each column is expected: correct them."
            )
        table = {str(name): array[:, i] for i, name in enumerate(names)}
    elif hasattr(data, "columns"):
        table = {str(name): _column(data[name]) for name in data.columns}
    elif isinstance(data, Mapping):
        table = {str(name): _column(values) for name, values in data.items()}
    else:
        raise SpecificationError(
            f"the data of a log is of the type {type(data).__name__}, but a DataFrame, a mapping "
            f"of names to columns, or an array with 'columns' is expected: give one, of a file by "
            f"analysis.log_report.read_table."
        )
    shapes = {name: values.shape for name, values in table.items()}
    if len(set(shapes.values())) != 1 or any(len(s) != 1 or s == (0,) for s in shapes.values()):
        shown = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise SpecificationError(
            f"the columns of a log have the shapes {shown or 'of nothing'}, but one number for "
            f"each row is expected of all: give columns of one length, without repeated names."
        )
    return table


def _column(values: Any) -> npt.NDArray[Any]:
    if getattr(getattr(values, "dtype", None), "tz", None) is not None:  # of pandas
        return np.asarray(values, dtype="datetime64[ns]")
    return np.asanyarray(values)  # masked arrays stay so


def clock_column(
    table: Mapping[str, Any], taken: Collection[str], time: Any, dt: float | None, notes: list[str]
) -> str | None:
    """Return the name of the column of the stamps, None where they are given or made of dt."""
    clocks = [name for name in table if clock_unit(name) is not None and name not in taken]
    found = [name for name in clocks if not clock_unit(name)] or clocks
    if time is not None and dt is not None:
        raise SpecificationError(
            f"a log has the time {time if isinstance(time, str) else 'of an array'!r} and dt = "
            f"{dt!r}, but one of the two is expected: leave one out."
        )
    if isinstance(time, str):
        if time not in table:
            raise unknown_name("column in 'time' of a log", time, table)
        return time
    if dt is not None:
        if not np.isreal(dt) or not 0 < dt < math.inf:
            raise SpecificationError(
                f"dt of a log is {dt!r}, but a positive number of seconds is expected: correct it."
            )
        notes.extend(f"Column {name!r} is not used: dt is given." for name in found)
        return None
    if time is not None:
        return None
    if len(found) != 1:
        raise SpecificationError(
            f"a log has the columns {', '.join(table)}, of which {' and '.join(found) or 'none'} "
            f"{'are' if found else 'is'} called time, t or timestamp, but one column of stamps is "
            f"expected: give its name (--time), or stamps such as table.index, as time, or the "
            f"time between two rows as dt (--dt), in seconds."
        )
    return found[0]


def _factor(name: str, unit: str | float, known: Mapping[str, float]) -> float:
    """Return the factor from a unit to the one of the plant."""
    if isinstance(unit, int | float | np.number) and math.isfinite(unit) and unit != 0:
        return float(unit)
    text = str(unit).strip()
    if re.fullmatch(r"-?\d*\.?\d+(e-?\d+)?", text) and float(text):  # of a command line
        return float(text)
    text = text if text in known else text.removesuffix("/s")
    counts = re.fullmatch(r"counts?/(\d+(?:\.\d+)?)", text) if "rad" in known else None
    if counts and float(counts[1]) > 0:
        return TURN / float(counts[1])
    if text not in known:
        words = ", ".join(known) + (", counts/4096 (counts a turn)" if "rad" in known else "")
        raise SpecificationError(
            f"the unit of column {name!r} of a log is {unit!r}, but one of {words}, or a factor "
            f"other than 0 is expected: give one."
        )
    return known[text]


def _numbers(name: str, values: npt.NDArray[Any]) -> Array:
    """Return a column as real numbers, NaN where one is missing or not finite."""
    if np.ma.isMaskedArray(values):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    if values.dtype.kind not in "fiubOUST":
        raise SpecificationError(
            f"column {name!r} of a log has the type {values.dtype}, but real numbers are "
            f"expected: convert it."
        )
    try:
        found: Array = values.astype(np.float64)
    except (TypeError, ValueError):
        found = np.array([_number(name, row, value) for row, value in enumerate(values)])
    found[~np.isfinite(found)] = np.nan
    return found


def _number(name: str, row: int, value: Any) -> float:
    text = str(value).strip()
    if text.lower() in _MISSING:
        return math.nan
    try:
        return float(text)
    except ValueError:
        comma = re.fullmatch(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?", text)
        hint = "correct it, or leave it empty where nothing was measured"
        if comma:
            hint = "write a decimal point (in pandas: read_csv(..., decimal=','))"
        elif re.search(r"\d[/.:]\d+[/.:]\d", text):
            hint = "write dates as 2026-11-29 12:30:00.5 (in pandas: to_datetime)"
        elif row == 0 and not re.search(r"\d", text):
            hint = "remove the row, if it holds units, and give them as units"
        raise SpecificationError(
            f"column {name!r} of a log is {text!r} in row {row}, but a number is expected: {hint}."
        ) from None


def values_of(
    name: str, values: npt.NDArray[Any], units: Mapping[str, str | float], notes: list[str]
) -> Array:
    """Return a column of states or inputs in the unit of the plant."""
    found = _numbers(name, values)
    if name not in units:
        if unit := UNIT_OF_ANGLE.search(name):
            notes.append(f"Column {name!r} is kept in {unit[1]}: units= or --units converts it.")
        return found
    factor = _factor(name, units[name], UNITS)
    notes.append(f"Column {name!r} is multiplied by {factor:.6g} ({units[name]}).")
    if str(units[name]).startswith("count"):
        for bits in (16, 32):
            jumps = int((np.abs(np.diff(found[np.isfinite(found)])) > 0.9 * 2.0**bits).sum())
            if jumps:
                notes.append(
                    f"The counter of {bits} bits in column {name!r} begins again "
                    f"{count_text(jumps, 'time')}: it goes on."
                )
                found = continued(found, 2.0**bits)
    return found * factor


def continued(values: Array, period: float) -> Array:
    """Return values without jumps by a period; what is missing stays missing."""
    there = np.isfinite(values)
    found = values.copy()
    found[there] = np.unwrap(values[there], period=period)
    return found


def stamps_of(
    table: Mapping[str, npt.NDArray[Any]],
    clock: str | None,
    time: Any,
    dt: float | None,
    unit: str | float,
    notes: list[str],
) -> Array:
    """Return the stamps of all rows [s], NaN where one is missing."""
    n_rows = len(next(iter(table.values())))
    if dt is not None:
        return np.arange(n_rows, dtype=np.float64) * dt
    values, name = (_column(time), "time") if clock is None else (table[clock], clock)
    if values.shape != (n_rows,):
        raise SpecificationError(
            f"time of a log has the shape {values.shape}, but a stamp for each of its {n_rows} "
            f"rows is expected: correct it."
        )
    values = _dates(values)
    if values.dtype.kind in "mM":
        elapsed = values - values[np.argmin(np.isnat(values))]
        kind = "dates" if values.dtype.kind == "M" else "spans of time"
        notes.append(f"Column {name!r} holds {kind}: times count from the first of them.")
        seconds: Array = elapsed / np.timedelta64(1, "ns") * 1e-9
        return seconds
    _check_resolution(name, values)
    factor = 1.0 if unit == 1.0 else _factor(name, unit, SECONDS)
    if factor != 1.0:
        notes.append(f"Stamps are multiplied by {factor:g} to be seconds.")
    is_whole = values.dtype.kind in "iu" and not np.ma.isMaskedArray(values)
    if is_whole:  # ns since 1970 have more digits than a float
        seconds = (values.astype(object) - int(values.flat[0])).astype(np.float64) * factor
    else:
        seconds = _numbers(name, values) * factor
    return _going_on(seconds, (2.0**32 * factor, *_ROLL_OVERS), notes)


def _dates(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return dates, texts of them in UTC, and spans of time in ns, anything else as it is."""
    if values.dtype.kind in "OUST":
        texts = [str(one).strip() for one in values]
        found = [_DATE.fullmatch(one) for one in texts]
        others = {text for text, one in zip(texts, found, strict=True) if not one}
        if any(found) and all(text.lower() in _MISSING for text in others):
            with contextlib.suppress(ValueError):  # of the 31st of February
                dates = [_utc(one[1], one[2]) if one else "NaT" for one in found]
                return np.array(dates, "datetime64[ns]")
        return values
    return values.astype(f"{kind}8[ns]") if (kind := values.dtype.kind) in "mM" else values


def _utc(date: str, offset: str | None) -> np.datetime64:
    ahead = datetime.fromisoformat(f"2000-01-01T00:00{offset or 'Z'}").utcoffset()
    return np.datetime64(date.replace(",", "."), "ns") - np.timedelta64(ahead)


def _check_resolution(name: str, values: npt.NDArray[Any]) -> None:
    """Refuse stamps in single precision whose steps are lost in it."""
    if values.dtype.kind != "f" or values.dtype.itemsize >= 8 or not np.isfinite(values).any():
        return
    found = values[np.isfinite(values)]
    spacing = float(np.spacing(np.abs(found).max()))
    mean = (float(found.max()) - float(found.min())) / max(len(found) - 1, 1)
    if spacing > 0.1 * mean or mean == 0:
        raise SpecificationError(
            f"the stamps in {name!r} of a log are of the type {values.dtype}, which cannot tell "
            f"{float(np.abs(found).max()):.10g} from values {spacing:.3g} away, but steps of "
            f"about {mean:.3g} are expected of it: read them as float64, or subtract the first "
            f"stamp before they are converted."
        )


def _going_on(seconds: Array, periods: Sequence[float], notes: list[str]) -> Array:
    """Return stamps of a 32-bit counter that began again as if it had gone on."""
    there = np.flatnonzero(np.isfinite(seconds))
    steps = np.diff(seconds[there])
    forward = steps[steps > 0]
    if not forward.size or not (steps < 0).any():
        return seconds
    longest = GAP * float(np.median(forward))
    for period in periods:
        over = (steps < 0) & (steps + period > 0) & (steps + period <= longest)
        if over.any():
            notes.append(
                f"The counter of the stamps begins again after {period:.6g} s at "
                f"{rows_text(there[1:][over])}: it goes on."
            )
            steps = steps + period * over
            seconds = seconds.copy()
            seconds[there[1:]] = seconds[there[0]] + np.cumsum(steps)
    return seconds


def rows_text(rows: npt.NDArray[np.intp]) -> str:
    """Return how many rows and which is the first: ``3 rows, first row 17``."""
    return f"row {rows[0]}" if len(rows) == 1 else f"{len(rows):,} rows, first row {rows[0]}"


def count_text(number: int, what: str) -> str:
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


_ONE_TURN = TURN * 1.01  # a wrapped angle with its noise

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
    - A 32-bit counter of µs or ms that begins again goes on.
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
        called time, t, timestamp or Zeit is taken, with a unit or without: ``time_ms``, ``t [s]``.
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
        if time is None and dt is None and {*map(clock_unit, {*table} - taken)} <= {None}:
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
            f"Log({self.n_rows:,} rows, {count_text(len(self.pieces), 'piece')}, {duration:g} s, "
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
            f"{count_text(passes, 'time')}: unwrapped."
        )
    return found


def _leave_out(name: str, y: Array, pieces: Rows, period: float, notes: list[str]) -> Integers:
    """Write NaN in the place of the outliers of a measured state, and return their rows."""
    there = [each[np.isfinite(y[each])] for each in pieces]
    found = [each[outliers(y[each], period)] for each in there if len(each) >= NEAR]
    rows = np.concatenate([*found, np.empty(0, np.intp)])
    if not 0 < len(rows) <= MOST_OUTLIERS * len(y):
        return rows[:0]
    notes.append(f"{count_text(len(rows), 'outlier')} of {name} left out, first row {rows[0]}.")
    y[rows] = np.nan
    return rows


def _note_missing(names: Sequence[str], measured: Array, notes: list[str]) -> None:
    for name, values in zip(names, measured.T, strict=True):
        lost = int(np.isnan(values).sum())
        if lost == len(values):
            raise SpecificationError(
                f"measured state {name!r} of a log has no value at all, but some numbers are "
                f"expected: leave it out of 'states', then a fit estimates it."
            )
        if lost:
            notes.append(
                f"State {name!r} is missing in {count_text(lost, 'row')}: it stays missing."
            )
