"""Rows from the database as Arrow batches; one batch at a time is in memory."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from orchestrate.export import columns
from orchestrate.store import ConfigRow, Reader, Trajectory
from orchestrate.store.serialization import unpack

ROWS = 50_000
"""Rows of the database in one batch."""

KEY_DIGITS = 12

_CURVES = f"""
SELECT r.seed, r.status, s.t, {", ".join(f"s.{name}" for name in columns.STEP_COLUMNS)}
FROM config c
JOIN trial r ON r.config_id = c.config_id
JOIN step s ON s.trial_id = r.trial_id
WHERE c.config_key = :config_key AND r.status IN ('done', 'diverged')
ORDER BY r.seed, s.t
"""
_TRIALS = f"""
SELECT {", ".join(columns.TRIALS.names)} FROM v_trial WHERE config_key = :config_key ORDER BY seed
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


@dataclass(frozen=True)
class Stream:
    """Columns and the batches of their rows."""

    schema: pa.Schema
    batches: Generator[pa.RecordBatch, None, None]


def curves(reader: Reader, configs: Sequence[ConfigRow]) -> Stream:
    """Return every step of the finished trials, sorted by configuration, seed and t."""
    return Stream(columns.CURVES, _curves(reader, configs))


def trials(reader: Reader, configs: Sequence[ConfigRow]) -> Stream:
    """Return every trial, sorted by configuration and seed."""
    return Stream(columns.TRIALS, _trials(reader, configs))


def trajectories(reader: Reader, configs: Sequence[ConfigRow]) -> Stream:
    """Return states and inputs of the finished trials, sorted by configuration, seed and t."""
    firsts = [next(of_config(reader, config, 1), None) for config in configs]
    n_states = max((one[2].states.shape[1] for one in firsts if one), default=0)
    n_inputs = max((one[2].inputs.shape[1] for one in firsts if one), default=0)
    schema = columns.trajectories(n_states, n_inputs)
    return Stream(schema, _trajectories(reader, configs, schema))


def assessments(reader: Reader, configs: Sequence[ConfigRow]) -> Stream:
    """Return what finished trials were worth, sorted by configuration, seed, t and measure."""
    return Stream(columns.ASSESSMENTS, _assessments(reader, configs))


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
            names = ("seed", "status", "t", *columns.STEP_COLUMNS)
            values = dict(zip(names, zip(*rows, strict=True), strict=True))
            yield _batch(columns.CURVES, {**_constants(config), **values}, len(rows))


def _assessments(
    reader: Reader, configs: Sequence[ConfigRow]
) -> Generator[pa.RecordBatch, None, None]:
    for config in configs:
        for rows in reader.batches(ROWS, _ASSESSMENTS, config_key=config.config_key):
            names = ("seed", "status", "t", "measure", "value")
            values = dict(zip(names, zip(*rows, strict=True), strict=True))
            yield _batch(columns.ASSESSMENTS, {**_constants(config), **values}, len(rows))


def _trials(reader: Reader, configs: Sequence[ConfigRow]) -> Generator[pa.RecordBatch, None, None]:
    for config in configs:
        for rows in reader.batches(ROWS, _TRIALS, config_key=config.config_key):
            values = dict(zip(columns.TRIALS.names, zip(*rows, strict=True), strict=True))
            yield _batch(columns.TRIALS, values, len(rows))


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
