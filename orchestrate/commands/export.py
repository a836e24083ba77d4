"""Command ``export``: results as a file for other programs, with a manifest of their origin."""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dopt import __version__
from dopt.errors import DoptError
from dopt.types import Array
from orchestrate.commands import Command, add_filters, answer, chosen
from orchestrate.commands.results import counts
from orchestrate.errors import ExitCode, whole
from orchestrate.program import UsageError, check_removed, path
from orchestrate.store import ConfigRow, Reader, Trajectory, public
from orchestrate.store.records import now, unpacked_trajectory
from orchestrate.store.schema import OUTCOME_COLUMNS, STEP_VALUES, trial

if TYPE_CHECKING:
    import pyarrow as pa

KINDS = ("curves", "trials", "trajectories", "assessments")
"""Exports that are one file."""

FORMATS = ("csv", "parquet")

_WRITERS = "SELECT DISTINCT config_key, launch_id FROM v_trial WHERE launch_id IS NOT NULL"


_TEXT, _WHOLE, _REAL = "string", "int64", "double"
_SECTIONS = dict.fromkeys(("env", "policy", "model", "learner"), _TEXT)
_SIZES = {"width": _WHOLE, "depth": _WHOLE}
_OUTCOME = {
    name: {int: _WHOLE, float: _REAL, str: _TEXT}[trial.c[name].type.python_type]
    for name in OUTCOME_COLUMNS
}
_STEP = {"seed": _WHOLE, "status": _TEXT, "t": _WHOLE}
_OF_CONFIG = {"config_key": _TEXT, **_SECTIONS, **_SIZES}

Columns = Mapping[str, str]
"""Kind of each column of a table."""

CURVES: Columns = {**_OF_CONFIG, **_STEP, **dict.fromkeys(STEP_VALUES, _REAL)}
"""One row for each step."""

TRIALS: Columns = {
    **{"trial_key": _TEXT, "config_key": _TEXT, **_SECTIONS, **_SIZES},
    **{"horizon": _WHOLE, "dt": _REAL, "gamma": _REAL},
    **{"seed": _WHOLE, "status": _TEXT, "attempt": _WHOLE, **_OUTCOME},
    **{"launch_id": _WHOLE, "error_type": _TEXT, "error_message": _TEXT},
}
"""One row for each trial, with or without a result."""

ASSESSMENTS: Columns = {**_OF_CONFIG, **_STEP, "measure": _TEXT, "value": _REAL}
"""One row for each measure of a trial after t explored steps."""

ROWS = 50_000
"""Rows of the database in one batch."""

_CURVES = f"""
SELECT r.seed, r.status, s.t, {", ".join(f"s.{name}" for name in STEP_VALUES)}
FROM config c
JOIN trial r ON r.config_id = c.config_id
JOIN step s ON s.trial_id = r.trial_id
WHERE c.config_key = :config_key AND r.status IN ('done', 'diverged')
ORDER BY r.seed, s.t
"""
_TRIALS = f"""
SELECT {", ".join(TRIALS)} FROM v_trial WHERE config_key = :config_key ORDER BY seed
"""
_TRAJECTORIES = """
SELECT r.seed, r.status, j.dtype, j.states_shape, j.states, j.inputs_shape, j.inputs,
       j.parameters_shape, j.parameters
FROM config c
JOIN trial r ON r.config_id = c.config_id
JOIN trajectory j ON j.trial_id = r.trial_id
WHERE c.config_key = :config_key AND r.status IN ('done', 'diverged')
ORDER BY r.seed
"""
_ASSESSMENTS = """
SELECT seed, status, t, measure, value FROM v_assessment
WHERE config_key = :config_key AND status IN ('done', 'diverged') ORDER BY seed, t, measure
"""

_SELECTED = {
    "curves": (CURVES, _CURVES),
    "trials": (TRIALS, _TRIALS),
    "assessments": (ASSESSMENTS, _ASSESSMENTS),
}
"""Columns of a table and the statement for the last of them, of one configuration."""


class ExportError(DoptError):
    """Empty selection, or file that cannot be written."""


def export(
    reader: Reader,
    configs: Sequence[ConfigRow],
    out: Path,
    kind: str,
    form: str,
    filters: Mapping[str, Sequence[str]],
) -> dict[str, Any]:
    """Write the file, and after it its manifest; return what the manifest says.

    Both appear whole or not at all. ``reader`` sees the moment of ``configs``; ``kind`` is one of
    ``KINDS`` and ``form`` one of ``FORMATS``. Raises ``ExportError``, or ``OutputError`` if they
    cannot be written.
    """
    _expect_trials(reader, configs, kind)
    with whole(_manifest(out)) as manifest, whole(out) as partial:
        content = _write(reader, configs, kind, form, partial)
        with partial.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        about = {"file": out.name, "bytes": partial.stat().st_size, "sha256": digest}
        document = {
            "kind": kind,
            "format": form,
            **about,
            **content,
            **provenance(reader, configs, filters),
        }
        manifest.write_text(json.dumps(document, indent=2) + "\n")
    return document


def _manifest(out: Path) -> Path:
    return out.with_name(f"{out.name}.manifest.json")


def _write(
    reader: Reader, configs: Sequence[ConfigRow], kind: str, form: str, out: Path
) -> dict[str, Any]:
    import pyarrow as pa  # other commands do without it
    from pyarrow import csv, parquet

    if kind == "trajectories":
        columns = _trajectory_columns(reader, configs)
        tables = _trajectories(reader, configs)
    else:
        columns, sql = _SELECTED[kind]
        tables = _selected(reader, configs, columns, sql)
    kinds = {name: pa.type_for_alias(kind) for name, kind in columns.items()}
    schema, rows = pa.schema(kinds), 0
    if form == "csv":
        writer = csv.CSVWriter(out, schema)
    else:
        writer = parquet.ParquetWriter(out, schema, compression="zstd")
    with closing(tables), writer:  # the tables after an error, before the database
        for table in _large(schema, (_batch(kinds, *one) for one in tables)):
            writer.write_table(table)
            rows += table.num_rows
    return {"rows": rows, "columns": {name: str(kind) for name, kind in kinds.items()}}


Part = tuple[Mapping[str, Any], int]
"""Values by column, one for all rows or one for each; number of rows."""


def _selected(
    reader: Reader, configs: Sequence[ConfigRow], columns: Columns, sql: str
) -> Generator[Part, None, None]:
    """Yield what a statement returns, by configuration; the other columns are constants."""
    for config in configs:
        for rows in reader.batches(ROWS, sql, config_key=config.config_key):
            names = [*columns][-len(rows[0]) :]
            values = dict(zip(names, zip(*rows, strict=True), strict=True))
            yield {**_constants(config), **values}, len(rows)


def _trajectory_columns(reader: Reader, configs: Sequence[ConfigRow]) -> Columns:
    """Return the columns of trajectories: one row for each t from 0 to T, without an input at T."""
    firsts = [next(_of_config(reader, config, 1), None) for config in configs]
    n_states = max((one[2].states.shape[1] for one in firsts if one), default=0)
    n_inputs = max((one[2].inputs.shape[1] for one in firsts if one), default=0)
    names = [f"state_{i}" for i in range(n_states)] + [f"input_{i}" for i in range(n_inputs)]
    return {**_OF_CONFIG, **_STEP, **dict.fromkeys(names, _REAL)}


def _trajectories(reader: Reader, configs: Sequence[ConfigRow]) -> Generator[Part, None, None]:
    for config in configs:
        size = max(1, ROWS // (config.horizon + 1))
        for seed, status, one in _of_config(reader, config, size):
            n = len(one.states)
            values = {"seed": seed, "status": status, "t": np.arange(n)}
            values |= _named("state", one.states, n) | _named("input", one.inputs, n)
            yield {**_constants(config), **values}, n


def _of_config(
    reader: Reader, config: ConfigRow, size: int
) -> Iterator[tuple[int, str, Trajectory]]:
    """Yield (seed, status, trajectory) of a configuration; ``size`` of them are read at a time."""
    for rows in reader.batches(size, _TRAJECTORIES, config_key=config.config_key):
        yield from ((seed, status, unpacked_trajectory(*row)) for seed, status, *row in rows)


def _named(name: str, array: Array, n: int) -> dict[str, Any]:
    """Return the columns of an array under their names, with NaN up to n rows."""
    padded = np.full((n, array.shape[1]), np.nan)
    padded[: len(array)] = array
    return {f"{name}_{i}": column for i, column in enumerate(padded.T)}


def _constants(config: ConfigRow) -> dict[str, Any]:
    return {name: getattr(config, name) for name in _OF_CONFIG}


def _batch(kinds: Mapping[str, pa.DataType], values: Mapping[str, Any], n: int) -> pa.RecordBatch:
    """Return n rows; a single value fills its column, and what is not finite is missing."""
    import pyarrow as pa

    def array(value: Any, kind: pa.DataType) -> pa.Array:
        if isinstance(value, tuple | np.ndarray):
            return pa.array(value, kind, from_pandas=True)
        return pa.nulls(n, kind) if value is None else pa.repeat(pa.scalar(value, kind), n)

    arrays = [array(values.get(name), kind) for name, kind in kinds.items()]
    return pa.RecordBatch.from_arrays(arrays, schema=pa.schema(kinds))


def _large(schema: pa.Schema, batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Table]:
    """Yield the rows in tables of many batches: small ones make a slow file of Parquet."""
    import pyarrow as pa

    waiting = list[pa.RecordBatch]()
    for batch in batches:
        waiting.append(batch)
        if sum(one.num_rows for one in waiting) >= 4 * ROWS:
            yield pa.Table.from_batches(waiting)
            waiting = []
    yield pa.Table.from_batches(waiting, schema)


def _expect_trials(reader: Reader, configs: Sequence[ConfigRow], kind: str) -> None:
    if not configs:
        raise ExportError(
            f"{reader.safe_url} holds no trials yet: run a launch that writes to it first."
        )
    if kind == "assessments" and not any(reader.measures(c.config_key) for c in configs):
        raise ExportError(
            "No trial of these was assessed, so that there are no assessments to export: run them "
            "with task=control."
        )
    if kind != "trials" and not any(config.n_done + config.n_diverged for config in configs):
        raise ExportError(
            f"No trial of these is done yet, so that there are no {kind} to export: run "
            f"the launch, or see status."
        )


def provenance(
    reader: Reader, configs: Sequence[ConfigRow], filters: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Return database, selection, configurations and launches, without passwords."""
    keys = {config.config_key for config in configs}
    writers = {row.launch_id for row in reader.rows(_WRITERS) if row.config_key in keys}
    launches = [public(one) for one in reader.launches() if one.launch_id in writers]
    return {
        "written": now(),
        "program": f"dopt {__version__}",
        "database": reader.safe_url,
        "schema_version": reader.schema_version(),
        "filters": {name: list(values) for name, values in filters.items()},
        "trials": dict(counts(configs)),
        "missing_values": "empty in csv, null in parquet: a loss that is not finite",
        "configs": {config.config_key: dict(config.config) for config in configs},
        "launches": launches,
    }


def _add_export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "kind",
        choices=KINDS,
        help="curves (a row for each step), trials (a row for each trial), trajectories (states "
        "and inputs) or assessments",
    )
    parser.add_argument("path", nargs="?", type=path("PATH"), metavar="PATH", help="file to write")
    parser.add_argument("--out", type=path("--out"), metavar="PATH", help="the same, as an option")
    parser.add_argument(
        "--format", choices=FORMATS, help="csv or parquet (as the name of the file ends)"
    )
    add_filters(parser)


def _run_export(arguments: argparse.Namespace) -> ExitCode:
    """Write the file and its manifest."""
    out = _target(arguments)
    form = arguments.format or _format_of(out)
    filters = {"env": arguments.env, "policy": arguments.policy}
    with Reader.open(arguments.db) as reader, reader.moment() as moment:
        configs = chosen(moment, arguments)
        document = export(moment, configs, out, arguments.kind, form, filters)
    size = f"{document['rows']:,} rows, {document['bytes']:,} bytes"
    line = f"{out}: {size}; from where: {_manifest(out)}"
    return answer(arguments, document, line)


def _target(arguments: argparse.Namespace) -> Path:
    given = [one for one in (arguments.path, arguments.out) if one is not None]
    if len(given) != 1:
        raise UsageError(
            f"{'Two paths are' if given else 'No path is'} given to write to, one is expected: "
            f"write export {arguments.kind} PATH."
        )
    out: Path = given[0]
    return out


def _format_of(path: Path) -> str:
    ending = path.suffix.removeprefix(".").lower()
    if ending not in FORMATS:
        check_removed(f"export {ending}")
        raise UsageError(
            f"The name of {path} does not say its format, {', '.join(FORMATS)} are known: give "
            f"--format or such an ending."
        )
    return ending


EXPORT_COMMAND = Command("export", "write results to a file", _run_export, _add_export_arguments)
