"""Batches into a CSV or a parquet file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from orchestrate.export.streams import ROWS, Stream


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
        for table in _gathered(stream.batches, 4 * ROWS):
            writer.write_table(table)
            n += table.num_rows
    return n


def _gathered(batches: Iterable[pa.RecordBatch], size: int) -> Iterator[pa.Table]:
    """Yield tables of at least ``size`` rows but the last: many small ones make a slow file."""
    waiting: list[pa.RecordBatch] = []
    for batch in batches:
        waiting.append(batch)
        if sum(one.num_rows for one in waiting) >= size:
            yield pa.Table.from_batches(waiting)
            waiting = []
    if waiting:
        yield pa.Table.from_batches(waiting)
