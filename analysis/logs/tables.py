"""Files of recorded runs as frames: CSV, Parquet, MAT and HDF5, and what their columns are."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from analysis.errors import AnalysisError
from dopt.errors import given_path, install_command
from dopt.log import CLOCKS, Log

INPUTS = re.compile(
    r"^u\d*$|input|volt|torque|^tau|current|pwm|force|throttle|command|(^|_)cmd($|_|\d)",
    re.IGNORECASE,
)
"""Columns that are taken for inputs where none are named."""

_COMMANDED = re.compile(r"con|cmd|command|des|ref", re.IGNORECASE)
_MEASURED = re.compile(r"meas", re.IGNORECASE)


def read_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """Return the table in a file, by the ending of its name.

    ``.csv`` and ``.csv.gz`` have a line of names; ``.parquet``; ``.mat`` of MATLAB, 7.3 included;
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
            f"{file} cannot be read ({error}), but a table by its ending {ending} is expected: "
            f"export it again."
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
    inputs = _guessed_inputs(table) if inputs is None else inputs
    if not inputs:
        raise AnalysisError(
            f"none of the columns {', '.join(map(str, table))} is named like an input (u, voltage, "
            f"torque, tau1, ...), but at least one input is expected: name it (inputs=, --inputs)."
        )
    if states is None:
        named = inputs.values() if isinstance(inputs, Mapping) else inputs
        taken = {*named, options["time"]} if isinstance(options.get("time"), str) else {*named}
        states = [
            one
            for one in map(str, table)
            if one not in taken and one.lower() not in CLOCKS
            if not is_flag(table[one]) and not INPUTS.search(one)
        ]
    return Log(table, states=states, inputs=inputs, **options)


def is_flag(values: pd.Series[Any]) -> bool:
    """Return whether a column is a flag: nothing but −1, 0 and 1, or truth values."""
    return bool(values.dtype.kind in "biu" and values.isin([-1, 0, 1]).all())


def _guessed_inputs(table: pd.DataFrame) -> list[str]:
    """Return columns named like inputs; of commanded and measured ones the measured."""
    found = [str(one) for one in table if INPUTS.search(str(one))]
    measured = [one for one in found if _MEASURED.search(str(one))]
    rest = [one for one in found if one not in measured]
    return measured if measured and all(_COMMANDED.search(str(one)) for one in rest) else found


def _csv(file: Path) -> pd.DataFrame:
    table = pd.read_csv(file, skipinitialspace=True)
    if table.shape[1] == 1 and ";" in str(table.columns[0]):
        raise ValueError("its columns are separated by ';', not by ','")
    return table


def _mat(file: Path) -> pd.DataFrame:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        found = loadmat(file, simplify_cells=True)
    except NotImplementedError:  # of version 7.3
        return _hdf5(file)
    except MatReadError as error:
        raise ValueError(error) from error
    return _of_variables(file, {k: v for k, v in found.items() if not k.startswith("__")})


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
    return pd.DataFrame({name: one for name, one in columns.items() if len(one) == rows})


def _flattened(found: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in found.items():
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
