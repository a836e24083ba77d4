"""Columns of a table as stamps and values of a log: clocks, units, dates, counters.

What is converted is said in notes. Rows are counted from 0.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Collection, Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError, counted, unknown_name
from dopt.types import Array

GAP = 10.0
"""Median steps after which a step is a gap, unless ``gap`` is given."""

TURN = 2.0 * math.pi

UNITS = {"rad": 1.0, "mrad": 1e-3, "deg": TURN / 360, "rev": TURN, "turn": TURN, "rpm": TURN / 60}
"""Units of angles, and what they are in radians; ``/s`` may follow, and ``counts/4096`` is one."""

SECONDS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
SECONDS |= {"min": 60.0, "h": 3600.0}
"""Units of time [s]."""

_CLOCK = re.compile(
    r"(?!(?-i:T)_|.*_(?:min|h)$)(?:time|t|timestamp|zeit|epoch|utc|tick)"  # no minimum
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
        if getattr(data.index, "dtype", np.dtype(int)).kind in "mM":  # of pandas, of stamps
            table.setdefault(str(data.index.name or "time"), _column(data.index))
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


def clocks_of(table: Any, taken: Collection[str]) -> list[str]:
    """Return the columns of stamps, by name, or else by their dates; one of a name's equal ones."""
    named = [name for name in table if clock_unit(name) is not None and name not in taken]
    found = [name for name in named if not clock_unit(name)] or named
    if not found:
        few = {name: _dates(_column(table[name][:100])) for name in table if name not in taken}
        found = [name for name, values in few.items() if values.dtype.kind in "mM"]
    same = all(np.array_equal(table[name], table[found[0]]) for name in found)
    return found[: 1 if same and len({n.rsplit(".")[-1] for n in found}) == 1 else None]


def clock_column(
    table: Mapping[str, Any], taken: Collection[str], time: Any, dt: float | None, notes: list[str]
) -> str | None:
    """Return the name of the column of the stamps, None where they are given or made of dt."""
    found = clocks_of(table, taken) if time is None else []
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
        elif not re.search(r"\d", text):
            hint = "remove the row, if it holds units, and give them as units; " * (row == 0)
            hint += "write words as numbers, such as 0 for OFF, or leave the column out"
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
        steps = np.abs(np.diff(found[np.isfinite(found)]))
        bits = 32 if steps.max(initial=0.0) > 0.9 * 2.0**32 else 16
        if jumps := int((steps > 0.9 * 2.0**bits).sum()):
            notes.append(
                f"The counter of {bits} bits in column {name!r} begins again "
                f"{counted(jumps, 'time')}: it goes on, from its value nearest to 0."
            )
            found = continued(found, 2.0**bits)
            found -= 2.0**bits * np.round(found[np.isfinite(found)][0] / 2.0**bits)
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
    return _going_on(seconds, (2.0**32 * factor, 2.0**16 * factor, *_ROLL_OVERS), notes)


def _dates(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return dates, texts of them in UTC, and spans of time in ns, anything else as it is."""
    if values.dtype.kind in "OUST":
        texts = [str(one).strip() for one in values]
        texts = [re.sub(r"^(?=\d\d:\d\d:\d\d)", "2000-01-01 ", text) for text in texts]
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
    if not (steps > 0).any():
        return seconds
    longest, seconds = GAP * float(np.median(steps[steps > 0])), seconds.copy()
    for period in periods:
        steps = np.diff(seconds[there])
        over = (steps < 0) & (steps + period > 0) & (steps + period <= longest)
        if over.any():
            notes.append(
                f"The counter of the stamps begins again after {period:.6g} s at "
                f"{rows_text(there[1:][over])}: it goes on."
            )
            seconds[there[1:]] += period * np.cumsum(over)
    return seconds


def rows_text(rows: npt.NDArray[np.intp]) -> str:
    """Return how many rows and which is the first: ``3 rows, first row 17``."""
    return f"row {rows[0]}" if len(rows) == 1 else f"{len(rows):,} rows, first row {rows[0]}"
