"""Measurements of speed that pages print, each a program: ``python -m studies.speed.width``."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from benchmarks.rows import Row, number


def show(rows: Iterable[Row]) -> None:
    """Print each row as it is measured."""
    for row in rows:
        value = "left out" if row.value is None else f"{number(row.value)} {row.unit}"
        sys.stdout.write(f"{row.what}: {value.strip()}{f' ({row.note})' if row.note else ''}\n")
        sys.stdout.flush()
