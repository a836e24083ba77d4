"""Recorded runs: reading of files, ``python -m analysis log FILE`` and ``fit PLANT LOG…``.

Files are CSV, Parquet, MAT and HDF5. The health of a run is one line a fact, with a picture; a fit
has a report, a picture and a model.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import itertools
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from analysis.data.matching import AnalysisError
from analysis.log_health import FEW, MOST_ROWS, PREDICTED, Effect, Health, Signal, examine
from analysis.style import number
from dopt.errors import counted, given_path, install_command
from dopt.log import Log
from dopt.log_columns import SECONDS, TURN, UNIT_OF_ANGLE, clock_unit, clocks_of
from dopt.systems.plant import Plant
from orchestrate.program import UsageError, folder, path, positive, tell
from orchestrate.store import Store

INPUTS = re.compile(
    r"(^|\.)u\d*([ _]?[\[(/].*)?$|input|volt|torque|^tau|current|pwm|force|throttle|command"
    r"|(^|_)cmd($|_|\d)",
    re.IGNORECASE,
)
"""Columns that are taken for inputs where none are named."""

LEFT_OUT = "left out"
"""Attribute of a table: a sentence on the variables of its file that are no columns."""

_COMMANDED = re.compile(r"con|cmd|command|des|ref", re.IGNORECASE)
_MEASURED = re.compile(r"meas", re.IGNORECASE)


def read_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """Return the table in a file, by the ending of its name.

    ``.csv`` and ``.csv.gz`` have a line of names, after comments and before a line of units where
    there are such, and commas, tabs, blanks, or semicolons with decimal commas or points;
    ``.parquet``; ``.mat`` of MATLAB, 7.3 included;
    ``.h5`` or ``.hdf5``. In the last two, variables of one length are columns, and those in a
    structure or a group are ``group.name``.

    Raises
    ------
    AnalysisError
        If the file is missing, has another ending, or holds no such table.
    """
    file = given_path(path, "the file of a log", AnalysisError)
    ending = next((one for one in _READERS if file.name.lower().endswith(one)), None)
    if ending is None:
        raise AnalysisError(
            f"{file} ends with {file.suffix or 'nothing'}, but a log is read from "
            f"{', '.join(_READERS)}: convert it, or give its columns to dopt.Log."
        )
    if not file.is_file():
        raise AnalysisError(f"{file} is no file, but the file of a log is expected: correct it.")
    try:
        table = _READERS[ending](file)
    except (ValueError, EOFError, OSError) as error:  # of each of the libraries
        raise AnalysisError(
            f"{file} cannot be read ({str(error).strip()}), but a table by its ending {ending} is "
            f"expected: export it again{', in UTF-8 with one line of names' * ('csv' in ending)}."
        ) from error
    if table.empty:
        raise AnalysisError(f"{file} has no rows, but a recorded run is expected: give another.")
    return table


def read_log(
    path: str | os.PathLike[str],
    *,
    states: Sequence[str] | Mapping[str, str] | None = None,
    inputs: Sequence[str] | Mapping[str, str] | None = None,
    **options: Any,
) -> Log:
    """Return the log in a file.

    Columns named like an input, such as u, voltage, torque or tau1, are the inputs unless they are
    given, and the others are the states, except for stamps and flags.

    Parameters
    ----------
    path : str or path
        File that :func:`read_table` reads.
    states, inputs, **options
        As of :class:`dopt.Log`.
    """
    return log_of(read_table(path), states, inputs, **options)


def log_of(
    table: pd.DataFrame,
    states: Sequence[str] | Mapping[str, str] | None = None,
    inputs: Sequence[str] | Mapping[str, str] | None = None,
    **options: Any,
) -> Log:
    """Return a log of a table, with the columns that are named like inputs for those."""
    table = table.rename(columns=str)
    if inputs is None:
        named = states.values() if isinstance(states, Mapping) else states or ()
        inputs = [one for one in _guessed_inputs(table) if one not in named]
    if not inputs:
        raise AnalysisError(
            f"none of the columns {', '.join(map(str, table))} is named like an input (u, voltage, "
            f"torque, tau1, ...), but at least one input is expected: name it (inputs=, --inputs)."
        )
    if states is None:
        named = inputs.values() if isinstance(inputs, Mapping) else inputs
        taken = {*named, *clocks_of(table, named)}
        taken |= {time} if isinstance(time := options.get("time"), str) else set()
        states = [
            one
            for one in map(str, table)
            if one not in taken and clock_unit(one) is None and not one.startswith("Unnamed: ")
            if not is_flag(table[one]) and not is_text(table[one]) and not INPUTS.search(one)
        ]
    log = Log(table, states=states, inputs=inputs, **options)
    if LEFT_OUT in table.attrs:
        log.notes = (table.attrs[LEFT_OUT], *log.notes)
    return log


def is_flag(values: pd.Series[Any]) -> bool:
    """Return whether a column is a flag: nothing but −1, 0 and 1, or truth values."""
    return bool(values.dtype.kind in "biu" and values.isin([-1, 0, 1]).all())


def is_text(values: pd.Series[Any]) -> bool:
    """Return whether a column has words, texts without a digit, or dates."""
    kinds, texts = r"\D*|\d{4}-\d\d-\d\d.*", values.dropna().astype(str)
    return values.dtype.kind in ("O", "T") and bool(texts.str.fullmatch(kinds).all())


def _guessed_inputs(table: pd.DataFrame) -> list[str]:
    """Return columns named like inputs; of commanded and measured ones the measured."""
    found = [one for one in map(str, table) if INPUTS.search(one) and clock_unit(one) is None]
    measured = [one for one in found if _MEASURED.search(one)]
    rest = [one for one in found if one not in measured]
    return measured if measured and all(_COMMANDED.search(one) for one in rest) else found


def _csv(file: Path) -> pd.DataFrame:
    for encoding in ("utf-8", "utf-16"):
        with contextlib.suppress(UnicodeError):
            return _csv_in(file, encoding)
    return _csv_in(file, "cp1252")  # of spreadsheets


def _csv_in(file: Path, encoding: str) -> pd.DataFrame:
    with (gzip.open if file.suffix == ".gz" else open)(file, "rt", encoding=encoding) as text:
        top = list(itertools.islice(text, 200)) or [""]
    usual = top[len(top) * 3 // 4]
    mark = next((one for one in ";\t," if one in usual), r"\s+")
    rows = [re.split(mark, line.lstrip("\ufeff").strip()) for line in top]
    half = (len(re.split(mark, usual.strip())) - 1) / 2  # a mark may end each line but the first
    number = re.compile(r'\s*"?[-+.]?\d[-+.,:/ \dTZeE]*"?\s*')
    numbers = (sum(map(bool, map(number.fullmatch, row))) for row in rows)
    data = next((k for k, n in enumerate(numbers) if n >= max(half, len(rows[k]) / 2)), 1)
    if not data:
        raise ValueError("its first line has numbers and no names of columns")
    units = [one.strip(' []()"') for one in rows[data - 1]]
    alike = data > 1 and len(rows[data - 2]) == len(units)
    has_units = alike and not SECONDS.keys().isdisjoint(units)
    skipped = [k for k in range(data) if k != data - 1 - has_units]
    options: Any = {"encoding": encoding, "skiprows": skipped, "skipinitialspace": True}
    decimal = "," if mark == ";" else "."
    table: pd.DataFrame = pd.read_csv(file, sep=mark, decimal=decimal, **options)
    if not isinstance(table.index, pd.RangeIndex):  # the first values of longer rows
        if table.iloc[:, -1].notna().any():
            raise ValueError("its rows have more values than its first line has names")
        table = table.reset_index().iloc[:, : len(table.columns)].set_axis(table.columns, axis=1)
    table.columns = [one.strip().lstrip("#%").strip() for one in table.columns]
    if has_units:
        both = zip(table.columns, units, strict=False)
        table.columns = [f"{name} [{unit}]" if unit else name for name, unit in both]
    return table


def _mat(file: Path) -> pd.DataFrame:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    with file.open("rb") as opened:
        if opened.read(len(_HDF5)) == _HDF5:  # of Octave
            return _hdf5(file)
    try:
        found = loadmat(file, simplify_cells=True)
    except NotImplementedError:  # of version 7.3
        return _hdf5(file)
    except MatReadError as error:
        raise ValueError(error) from error
    return _of_variables(file, {k: v for k, v in found.items() if not k.startswith("__")})


_HDF5 = b"\x89HDF\r\n\x1a\n"


def _hdf5(file: Path) -> pd.DataFrame:
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise AnalysisError(
            f"{file} is in the format HDF5, which needs the library h5py: install it with "
            f"{install_command('logs')}."
        ) from error
    found: dict[str, Any] = {}

    def take(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):
            found[name.replace("/", ".")] = item[()]

    with h5py.File(file) as opened:
        opened.visititems(take)
    return _of_variables(file, found)


def _of_variables(file: Path, variables: Mapping[str, Any]) -> pd.DataFrame:
    """Return the variables of the commonest length as columns."""
    arrays = dict(_flattened(variables))
    columns: dict[str, np.ndarray[Any, Any]] = {}
    for name, array in arrays.items():
        if array.ndim == 2 and array.shape[0] < array.shape[1]:
            array = array.T
        if array.ndim == 2 and array.shape[1] > 1:
            columns |= {f"{name}{i + 1}": array[:, i] for i in range(array.shape[1])}
        elif array.size > 1 and array.dtype.kind in "fiubM":
            columns[name] = array.ravel()
    lengths = [len(column) for column in columns.values()]
    rows = max(set(lengths), key=lengths.count, default=0)
    if lengths.count(rows) < 2 or lengths.count(rows) < len(lengths) / 2:
        shown = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise AnalysisError(
            f"{file} holds {shown or 'no arrays'}, but variables of one length are expected of a "
            f"log: give the ones of one run to dopt.Log."
        )
    table = pd.DataFrame({name: one for name, one in columns.items() if len(one) == rows})
    others = [f"{name} ({len(one):,})" for name, one in columns.items() if len(one) != rows]
    if others:
        table.attrs[LEFT_OUT] = f"Not of {rows:,} values, left out: {', '.join(others)}."
    return table


def _flattened(found: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in found.items():
        if isinstance(value, list) and all(isinstance(one, Mapping) for one in value):
            value = {
                one.get("label") or str(i): one.get("values", one)  # of Simulink
                for i, one in enumerate(value, 1)
            }
        elif isinstance(value, np.ndarray) and value.dtype.names:
            value = {one: value[one] for one in value.dtype.names}
        if isinstance(value, Mapping):
            yield from _flattened(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", np.asarray(value)


_READERS: dict[str, Callable[[Path], pd.DataFrame]] = {
    ".csv": _csv,
    ".csv.gz": _csv,
    ".parquet": pd.read_parquet,
    ".mat": _mat,
    ".h5": _hdf5,
    ".hdf5": _hdf5,
}


HELP = "how healthy a recorded run is: sampling, noise, limits, delay, feedback, units"

PICTURES = (".png", ".pdf", ".svg")

RESTS = 0.2
"""Share of a log at rest from which the report says so."""

UNEVEN = 0.05
"""Share of irregular steps from which the report says that effects do not heed them."""

_MANY_TURNS = 100.0  # radians

_NO_ANGLE = re.compile(r"[\[(/_ ](°C|degC|[kcm]?m|m?[AVK]|k?N|k?Pa|m?bar|k?g|%)[\])]?$")
"""Ends of names that say a unit which is of no angle."""


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Add the file and the options of the command ``log``."""
    command.add_argument("file", metavar="FILE", help=".csv, .csv.gz, .parquet, .mat or .h5")
    _add_log_options(command)
    command.add_argument("--angles", help="states that are angles, in rad or --units: unwrapped")
    command.add_argument("--out", type=path("--out"), help="picture (figures/NAME.png)")


def _add_log_options(command: argparse.ArgumentParser) -> None:
    """Add the options that say how a file becomes a log."""
    for option, kind, what in (
        ("--columns", str, "states and inputs with their columns, such as angle=th,voltage=u"),
        ("--states", str, "measured states, such as th or angle=th,rate=om"),
        ("--inputs", str, "inputs, such as u or voltage=u (log: what is named like an input)"),
        ("--units", str, "units of columns, such as t=ms,th=counts/4096"),
        ("--time", str, "column of the stamps (time, t, timestamp or Zeit, also with a unit)"),
        ("--dt", positive("--dt", float), "seconds between two rows without stamps"),
        ("--gap", positive("--gap", float), "longest step within a piece [s] (10 medians)"),
    ):
        command.add_argument(option, type=kind, help=what)


def _log_options(options: argparse.Namespace) -> tuple[dict[str, Any], list[dict[str, str]]]:
    """Return what both commands give to a log, and its states and inputs with their columns."""
    names = ("--columns", "--states", "--inputs", "--units")
    both, *own, units = (names_of(one, getattr(options, one[2:])) for one in names)
    for name, column in both.items():
        if name not in {**own[0], **own[1]}:
            own[bool(INPUTS.search(name) or INPUTS.search(column))][name] = column
    return {"time": options.time, "dt": options.dt, "gap": options.gap, "units": units}, own


def run(options: argparse.Namespace) -> int:
    """Print the report of a log and save its picture."""
    target = options.out or Path("figures") / f"{Path(options.file).name.split('.')[0]}.png"
    if target.suffix not in PICTURES:
        raise UsageError(
            f"--out is {str(target)!r}, but a name with one of the endings {', '.join(PICTURES)} "
            f"is expected: give one."
        )
    table = read_table(options.file).rename(columns=str)
    given, (states, inputs) = _log_options(options)
    angles = (*names_of("--angles", options.angles),)
    log = log_of(table, states or None, inputs or None, angles=angles, **given)
    units = dict.fromkeys(angles, "rad") | given["units"]
    for name, column in {**states, **inputs}.items():
        if column in units:
            units[name] = units[column]
        elif name != column and (unit := _NO_ANGLE.search(column)):
            units.setdefault(name, unit[1])
    if options.dt is not None:
        units["time"] = "s"
    health, file = examine(log), Path(options.file)
    guessed = " (named like inputs: --inputs says otherwise)" * (not inputs)
    for line in (f"{file.name}: {log!r}{guessed}", *lines(log, health, table, units)):
        tell(sys.stdout, f"{line}\n")
    from analysis.figures.reports import draw_log  # Matplotlib: other commands do without it

    draw_log(log, health, target, file.name)
    tell(sys.stdout, f"picture: {target}\n")
    return 0


def names_of(option: str, text: str | None) -> dict[str, str]:
    """Return the columns that an option names, by state or input."""
    found = {}
    for part in text.split(",") if text is not None else ():
        name, equals, column = (one.strip() for one in part.partition("="))
        if not name or (equals and not column) or (option == "--units" and not equals):
            raise UsageError(
                f"{option} is {text!r}, but names that commas separate are expected, such as "
                f"{'th=deg' if option == '--units' else 'th or angle=th'}: correct it."
            )
        found[name] = column or name
    return found


def lines(
    log: Log, health: Health, table: pd.DataFrame, units: Mapping[str, str] | None = None
) -> Iterator[str]:
    """Yield the sentences of the report: sampling, signals, inputs, suspicions, notes.

    ``units`` are the ones that were declared, by state, input or "time": they are not doubted.
    """
    units = units or {}
    told = "time" in units or any(clock_unit(str(one)) for one in table)
    told |= any("Stamps are" in one or ": times count" in one for one in log.notes)
    yield f"sampling: {_sampling(log, health, told)}"
    for one in health.states:
        unit = _unit(units.get(one.name))
        yield f"{one.name}{unit}: {_signal(one)}, noise at most {number(one.noise)}"
        named = _NO_ANGLE.search(one.name) or UNIT_OF_ANGLE.search(one.name)
        yield from _units(one, one.name in units or bool(named))
    for one in health.inputs:
        yield f"{one.name}{_unit(units.get(one.name))}: {_signal(one)}{_limits(one)}"
    wrapped = [one.name for one in health.states if not math.isnan(one.period)]
    if wrapped:
        yield f"effects of the inputs: not judged while {', '.join(wrapped)} wraps"
    else:
        yield from (line for effect in health.effects for line in _effect(effect, health))
    if health.effects and health.irregular > UNEVEN:
        yield "effects of the inputs: as if all steps were of the median length"
    unseen = {*log.inputs} - {effect.input for effect in health.effects}
    few = "constant, or too few rows in a row that have all states to see its effect"
    yield from (f"{name}: {few}" for name in sorted(unseen))
    yield from _rest(log, health)
    if log.n_rows > MOST_ROWS:
        yield f"effects of the inputs: of the first {MOST_ROWS:,} rows"
    yield from _others(log, table)
    yield from (f"note: {note}" for note in log.notes)


def _seconds(time: float) -> str:
    return f"{number(1e3 * time)} ms" if time < 1 else f"{number(time)} s"


def _sampling(log: Log, health: Health, told: bool) -> str:
    steps = [_seconds(one) for one in (health.step, health.shortest, health.longest)]
    text = f"median step {steps[0]}, {steps[1]} to {steps[2]}"
    if steps[1] == steps[2]:
        text = f"every {steps[0]}"
    if health.irregular > 0:
        text += f", {100 * health.irregular:.2g} % of the steps off by more than 20 %"
    text += f", {counted(len(log.pieces), 'piece')} without gaps"
    if health.step >= 1 and not told:
        likely = "ms" if health.step < 1e3 else "us" if health.step < 1e6 else "ns"
        text += f"; stamps in {likely}? A step of {number(health.step)} s is long: "
        text += f"--units time={likely}"
    return text


def _unit(given: str | None) -> str:
    """Return the unit that a column has in the log, and the declared one that it had before."""
    if given is None or re.fullmatch(r"[-\d.e]+", given):
        return f" (times {given})" if given else ""
    if _NO_ANGLE.fullmatch(f"_{given}"):
        return f" [{given}]"
    unit = "rad/s" if given.endswith("/s") or given == "rpm" else "rad"
    return f" [{unit}]" if given == unit else f" [{unit}, from {given}]"


def _signal(one: Signal) -> str:
    text = f"{number(one.low)} to {number(one.high)}"
    if one.levels < FEW:
        return f"{text}, {counted(one.levels, 'level')}"
    if math.isnan(one.quantum):
        return f"{text}, no steps"
    turn = TURN / one.quantum
    whole = abs(turn - round(turn)) < min(1e-3 * max(1.0, turn / 1000), 0.05) and turn > 50
    return f"{text}, steps of {one.quantum:.6g}{f' ({round(turn):,} a turn)' * whole}"


def _limits(one: Signal) -> str:
    rows = [
        f"{count:,} rows at {number(end)}"
        for count, end in ((one.at_low, one.low), (one.at_high, one.high))
        if count
    ]
    return f", saturated: {' and '.join(rows)}" if rows else ", not saturated"


def _units(one: Signal, declared: bool) -> Iterator[str]:
    """Yield what a state's values say of its unit, and of what stands for a missing one."""
    if one.alone is not None:
        value, rows = one.alone
        yield (
            f"{one.name}: {value:g} in {counted(rows, 'row')}, far from all others: not "
            f"measured there? Leave such values empty"
        )
    span = one.high - one.low
    whole = one.quantum == round(one.quantum, 6) and one.quantum >= 1
    if not math.isnan(one.period):
        unit = {1.0: "rev", TURN: "rad", 360.0: "deg"}.get(one.period, f"counts/{one.period:.0f}")
        words = {"rad": "name it in --angles"}.get(unit, f"--angles and --units {one.name}={unit}")
        if one.period >= 2.0**16:
            words = f"or a counter? --units {one.name}=counts/N, N a turn"
        yield f"{one.name}: wraps about every {one.period:.6g}: an angle in {unit}? {words}"
    elif declared:
        return
    elif whole and span > 50:
        yield (
            f"{one.name}: whole numbers over {span:.6g}: degrees, or counts of an encoder? "
            f"--units {one.name}=deg or {one.name}=counts/N"
        )
    elif span > _MANY_TURNS and not math.isnan(one.quantum):
        yield (
            f"{one.name}: {span / TURN:.3g} turns if it is an angle in radians; degrees? "
            f"--units {one.name}=deg"
        )


def _effect(effect: Effect, health: Health) -> Iterator[str]:
    told = 100 * (1 - effect.open)
    pair = f"{effect.input} on {effect.state}"
    if effect.follows_state:
        yield (
            f"{effect.input}: this input explains nothing here: it follows the measured state "
            f"(R² = {told / 100:.3f}), so that a fit learns this law and not the plant"
        )
    elif effect.explains_nothing:
        yield (
            f"{effect.input}: this input explains nothing here: it varies on its own, but its "
            f"effect is {effect.steadiness:.1f} standard errors; motor off, or the wrong column?"
        )
    elif not effect.has_effect:
        yield f"{effect.input}: effect not told apart: the state tells {told:.0f} % of this input"
    else:
        yield (
            f"{pair}: explains {100 * effect.explained.max():.0f} % of the acceleration that "
            f"the state leaves open ({effect.steadiness:.0f} standard errors)"
        )
    if effect.delays is None:
        yield f"{pair}: delay not told apart"
    else:
        first, last = (max(0, one) for one in effect.delays)
        samples = f"{first}" if first == last else f"{first} to {last}"
        about = "; about, as noise is fed back" * effect.closed_loop
        samples += f" sample{'s' * (last != 1)} of {_seconds(health.step)}"
        yield f"{pair}: suspected delay: {samples}{about}"
    if effect.may_be_closed:
        what = "a function of the state" if effect.follows_state else "its own past tells all of it"
        yield f"{effect.input}: closed loop, or as regular as the motion: {what}"
    elif effect.closed_loop:
        yield (
            f"{effect.input}: closed loop: measurements explain {100 * effect.feedback:.0f} % of "
            f"what its own past leaves open"
        )
    else:
        alone = ": its own past tells all of it" * (effect.predicted > PREDICTED)
        yield f"{effect.input}: open loop, as far as can be seen{alone}"


def _rest(log: Log, health: Health) -> Iterator[str]:
    """Yield where nothing moves, and whether an input acts there."""
    rests = health.resting
    if rests.mean() < RESTS:
        return
    bounds = np.flatnonzero(np.diff(np.r_[False, rests, False].astype(int)))
    longest = int(np.diff(bounds)[::2].max())
    applied = np.abs(np.concatenate([piece.inputs for piece in log.pieces]))
    blocks = np.array_split(applied, len(rests))
    most = np.max([block.max(axis=0) for block, rest in zip(blocks, rests, strict=True) if rest], 0)
    acts = ", ".join(
        f"|{name}| up to {number(value)}" for name, value in zip(log.inputs, most, strict=True)
    )
    yield (
        f"rest: nothing moves in {100 * rests.mean():.0f} % of the log, in {longest} % of it on "
        f"end, with {acts} there: dry friction, held, regulated or without power; little is "
        f"learned there"
    )


def _others(log: Log, table: pd.DataFrame) -> Iterator[str]:
    """Yield the columns that are neither states nor inputs."""
    used = {*log.states, *log.inputs, *clocks_of(table, log.states)}
    for name in table.columns.difference([*used], sort=False):
        if is_flag(table[name]):
            yield f"{name}: a flag, not 0 in {int((table[name] != 0).sum()):,} rows"
        elif is_text(table[name]):
            yield f"{name}: words, not used"


FIT_HELP = "fit a plant's unknown constants and a network to recorded runs: report, picture, model"


def add_fit_arguments(command: argparse.ArgumentParser) -> None:
    """Add the files and the options of the command."""
    command.add_argument("plant", metavar="PLANT", help="the arguments of dopt.Plant (.yaml)")
    command.add_argument("logs", metavar="LOG", nargs="+", help="files as the command log reads")
    command.add_argument("--validate", metavar="LOG", nargs="+", default=(), help="other runs")
    _add_log_options(command)
    command.add_argument("--width", type=int, default=16, help="units of the network, 0: none (16)")
    holds = ("zero", "linear", "cubic")
    command.add_argument("--hold", choices=holds, default="zero", help="input between rows (zero)")
    command.add_argument("--window", type=positive("--window", float), help="window [s] (chosen)")
    command.add_argument("--out", type=folder("--out"), default="fit", help="folder (fit/)")
    command.add_argument("--db", metavar="URL", help="stores the fit: sqlite:///results.db (none)")


def run_fit(options: argparse.Namespace) -> int:
    """Fit, print the report, save the picture and the model, and store the fit where asked."""
    import dopt

    if options.db:
        Store.open(options.db).close()  # before minutes of fitting
    plant = read_plant(options.plant)
    given, (states, inputs) = _log_options(options)
    given["columns"] = {**states, **inputs}
    logs = [_log(file, plant, given) for file in options.logs]
    tests = [_log(file, plant, given) for file in options.validate]
    options.out.mkdir(parents=True, exist_ok=True)
    found = dopt.fit(
        plant,
        logs,
        validate=tests or None,
        width=options.width,
        hold=options.hold,
        window=options.window,
        progress=lambda text: tell(sys.stderr, f"{text}\n"),
    )
    tell(sys.stdout, f"{found.report()}\n")
    found.save(options.out / "model.npz")
    tell(sys.stdout, f"model: {options.out / 'model.npz'}\n")
    if options.db:
        tell(sys.stdout, f"trial: {found.store(options.db)}\n")
    from analysis.figures.reports import draw_fit  # Matplotlib: other commands do without it

    draw_fit(found, (tests or logs)[0], options.out / "fit.png")
    tell(sys.stdout, f"picture: {options.out / 'fit.png'}\n")
    return 0


def read_plant(file: str) -> Plant:
    """Return the plant that a YAML file declares.

    An unknown number is ``{value: 25, factor: 2}`` or ``{value: 0, spread: 0.1}``, an encoder
    ``{counts: 2048}``.

    Raises
    ------
    AnalysisError
        If the file cannot be read, or is no mapping.
    SpecificationError
        If the plant is not as :class:`dopt.Plant` says.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError  # type: ignore[import-untyped]  # which has no types

    source = given_path(file, "the file of a plant", AnalysisError)
    try:
        section: Any = OmegaConf.to_container(OmegaConf.load(source), resolve=True)
    except (OSError, ValueError, YAMLError, OmegaConfBaseException) as error:
        raise AnalysisError(
            f"{source} cannot be read ({error}), but the arguments of dopt.Plant in YAML are "
            f"expected: correct it."
        ) from error
    if not isinstance(section, dict):
        raise AnalysisError(
            f"{source} holds a {type(section).__name__}, but the arguments of dopt.Plant by their "
            f"names are expected, such as 'dt: 0.01': correct it."
        )
    return Plant.from_mapping(section)


def _log(file: str, plant: Plant, given: dict[str, Any]) -> Log:
    log = Log.for_plant(read_table(file).rename(columns=str), plant, **given)
    for note in log.notes:
        tell(sys.stderr, f"{Path(file).name}: {note}\n")
    return log
