"""Results as tables: rows of the database, and their files; one Arrow batch at a time."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from orchestrate.store import ConfigRow, Reader, Trajectory
from orchestrate.store.records import unpack
from orchestrate.store.schema import OUTCOME_COLUMNS, trial

_TEXT, _WHOLE, _REAL = pa.string(), pa.int64(), pa.float64()
STEP_COLUMNS = ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us")
_NAMES = (("env", _TEXT), ("policy", _TEXT), ("model", _TEXT), ("learner", _TEXT))
_SIZES = (("width", _WHOLE), ("depth", _WHOLE))
_KINDS = {int: _WHOLE, float: _REAL, str: _TEXT}
_OUTCOME = tuple((name, _KINDS[trial.c[name].type.python_type]) for name in OUTCOME_COLUMNS)

CURVES = pa.schema(
    [
        ("config", _TEXT),
        *_NAMES,
        *_SIZES,
        ("seed", _WHOLE),
        ("status", _TEXT),
        ("t", _WHOLE),
        *((name, _REAL) for name in STEP_COLUMNS),
    ]
)
"""One row for each step; ``config`` is the beginning of the configuration's key."""

TRIALS = pa.schema(
    [
        ("trial_key", _TEXT),
        ("config_key", _TEXT),
        *_NAMES,
        *_SIZES,
        *(("horizon", _WHOLE), ("dt", _REAL), ("gamma", _REAL)),
        *(("seed", _WHOLE), ("status", _TEXT), ("attempt", _WHOLE)),
        *_OUTCOME,
        *(("launch_id", _WHOLE), ("error_type", _TEXT), ("error_message", _TEXT)),
    ]
)
"""One row for each trial, with or without a result."""


ASSESSMENTS = pa.schema(
    [
        ("config", _TEXT),
        *_NAMES,
        *_SIZES,
        *(("seed", _WHOLE), ("status", _TEXT), ("t", _WHOLE), ("measure", _TEXT), ("value", _REAL)),
    ]
)
"""One row for each measure of a trial after t explored steps."""

ROWS = 50_000
"""Rows of the database in one batch."""

KEY_DIGITS = 12

_CURVES = f"""
SELECT r.seed, r.status, s.t, {", ".join(f"s.{name}" for name in STEP_COLUMNS)}
FROM config c
JOIN trial r ON r.config_id = c.config_id
JOIN step s ON s.trial_id = r.trial_id
WHERE c.config_key = :config_key AND r.status IN ('done', 'diverged')
ORDER BY r.seed, s.t
"""
_TRIALS = f"""
SELECT {", ".join(TRIALS.names)} FROM v_trial WHERE config_key = :config_key ORDER BY seed
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


def trajectory_columns(n_states: int, n_inputs: int) -> pa.Schema:
    """Return the columns of trajectories: one row for each t from 0 to T, without an input at T."""
    kept = [field for field in CURVES if field.name not in STEP_COLUMNS]
    states = [pa.field(f"state_{i}", _REAL) for i in range(n_states)]
    inputs = [pa.field(f"input_{i}", _REAL) for i in range(n_inputs)]
    return pa.schema([*kept, *states, *inputs])


@dataclass(frozen=True)
class Stream:
    """Columns and the batches of their rows."""

    schema: pa.Schema
    batches: Generator[pa.RecordBatch, None, None]


def curves(reader: Reader, configs: Sequence[ConfigRow]) -> Stream:
    """Return every step of the finished trials, sorted by configuration, seed and t."""
    return Stream(CURVES, _curves(reader, configs))


def trials(reader: Reader, configs: Sequence[ConfigRow]) -> Stream:
    """Return every trial, sorted by configuration and seed."""
    return Stream(TRIALS, _trials(reader, configs))


def trajectories(reader: Reader, configs: Sequence[ConfigRow]) -> Stream:
    """Return states and inputs of the finished trials, sorted by configuration, seed and t."""
    firsts = [next(of_config(reader, config, 1), None) for config in configs]
    n_states = max((one[2].states.shape[1] for one in firsts if one), default=0)
    n_inputs = max((one[2].inputs.shape[1] for one in firsts if one), default=0)
    schema = trajectory_columns(n_states, n_inputs)
    return Stream(schema, _trajectories(reader, configs, schema))


def assessments(reader: Reader, configs: Sequence[ConfigRow]) -> Stream:
    """Return what finished trials were worth, sorted by configuration, seed, t and measure."""
    return Stream(ASSESSMENTS, _assessments(reader, configs))


def steps(reader: Reader, config: ConfigRow) -> Generator[list[Sequence[Any]], None, None]:
    """Yield (seed, status, t, *STEP_COLUMNS) of the finished trials, in batches, by seed and t."""
    yield from reader.batches(ROWS, _CURVES, config_key=config.config_key)


def of_config(
    reader: Reader, config: ConfigRow, size: int
) -> Iterator[tuple[int, str, Trajectory]]:
    """Yield (seed, status, trajectory) of a configuration; ``size`` of them are read at a time."""
    for rows in reader.batches(size, _TRAJECTORIES, config_key=config.config_key):
        for seed, status, dtype, *packed in rows:
            arrays = [unpack(dtype, *packed[i : i + 2]) for i in (0, 2, 4)]
            yield seed, status, Trajectory(*arrays)


def _curves(reader: Reader, configs: Sequence[ConfigRow]) -> Generator[pa.RecordBatch, None, None]:
    for config in configs:
        for rows in steps(reader, config):
            names = ("seed", "status", "t", *STEP_COLUMNS)
            values = dict(zip(names, zip(*rows, strict=True), strict=True))
            yield _batch(CURVES, {**_constants(config), **values}, len(rows))


def _assessments(
    reader: Reader, configs: Sequence[ConfigRow]
) -> Generator[pa.RecordBatch, None, None]:
    for config in configs:
        for rows in reader.batches(ROWS, _ASSESSMENTS, config_key=config.config_key):
            names = ("seed", "status", "t", "measure", "value")
            values = dict(zip(names, zip(*rows, strict=True), strict=True))
            yield _batch(ASSESSMENTS, {**_constants(config), **values}, len(rows))


def _trials(reader: Reader, configs: Sequence[ConfigRow]) -> Generator[pa.RecordBatch, None, None]:
    for config in configs:
        for rows in reader.batches(ROWS, _TRIALS, config_key=config.config_key):
            values = dict(zip(TRIALS.names, zip(*rows, strict=True), strict=True))
            yield _batch(TRIALS, values, len(rows))


def _trajectories(
    reader: Reader, configs: Sequence[ConfigRow], schema: pa.Schema
) -> Generator[pa.RecordBatch, None, None]:
    for config in configs:
        size = max(1, ROWS // (config.horizon + 1))
        for seed, status, one in of_config(reader, config, size):
            n = len(one.states)
            values = {"seed": seed, "status": status, "t": np.arange(n)}
            values |= _named("state", one.states, n) | _named("input", one.inputs, n)
            yield _batch(schema, {**_constants(config), **values}, n)


def _named(name: str, array: npt.NDArray[np.float64], n: int) -> dict[str, Any]:
    """Return the columns of an array under their names, with NaN up to n rows."""
    padded = np.full((n, array.shape[1]), np.nan)
    padded[: len(array)] = array
    return {f"{name}_{i}": column for i, column in enumerate(padded.T)}


def _constants(config: ConfigRow) -> dict[str, Any]:
    names = ("env", "policy", "model", "learner", "width", "depth")
    return {
        "config": config.config_key[:KEY_DIGITS],
        **{name: getattr(config, name) for name in names},
    }


def _batch(schema: pa.Schema, values: Mapping[str, Any], n: int) -> pa.RecordBatch:
    """Return n rows; a single value fills its column, and what is not finite is missing."""
    arrays = [_array(values.get(field.name), field.type, n) for field in schema]
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


def _array(value: Any, kind: pa.DataType, n: int) -> pa.Array:
    if isinstance(value, tuple | np.ndarray):
        return pa.array(value, kind, from_pandas=True)
    return pa.nulls(n, kind) if value is None else pa.repeat(pa.scalar(value, kind), n)


def write_csv(path: Path, stream: Stream) -> int:
    """Write the rows, missing values empty; return how many."""
    n = 0
    with pyarrow.csv.CSVWriter(path, stream.schema) as writer:
        for batch in stream.batches:
            writer.write_batch(batch)
            n += batch.num_rows
    return n


def write_parquet(path: Path, stream: Stream) -> int:
    """Write the rows, missing values null; return how many."""
    n = 0
    with pyarrow.parquet.ParquetWriter(path, stream.schema, compression="zstd") as writer:
        for table in gathered(stream.batches, 4 * ROWS, "num_rows"):
            writer.write_table(table)
            n += table.num_rows
    return n


def gathered(batches: Iterable[pa.RecordBatch], least: int, of: str) -> Iterator[pa.Table]:
    """Yield tables with at least so many ``of`` (an attribute), except the last one.

    Many small tables make a slow file.
    """
    waiting: list[pa.RecordBatch] = []
    for batch in batches:
        waiting.append(batch)
        if sum(getattr(one, of) for one in waiting) >= least:
            yield pa.Table.from_batches(waiting)
            waiting = []
    if waiting:
        yield pa.Table.from_batches(waiting)


STREAMS: dict[str, Callable[[Reader, Sequence[ConfigRow]], Stream]] = {
    "curves": curves,
    "trials": trials,
    "trajectories": trajectories,
    "assessments": assessments,
}
WRITERS = {"csv": write_csv, "parquet": write_parquet}
