"""Records of an offline run of Weights & Biases, which its library no longer reads in Python.

A file has a head of 7 bytes and then blocks of 32 KiB of LevelDB's log format. The records are
parsed by the library's own message classes.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_HEAD = 7
_BLOCK = 32_768
_WHOLE, _LAST = 1, 4


@dataclass
class OfflineRun:
    """One run: its name, configuration, rows of the history, and last summary."""

    name: str = ""
    project: str = ""
    config: dict[str, Any] = field(default_factory=dict)
    history: list[dict[str, Any]] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    is_finished: bool = False


def read_run(path: Path) -> OfflineRun:
    """Return the run that is in a file ``*.wandb``."""
    from wandb.proto import wandb_internal_pb2

    run = OfflineRun()
    for data in _records(path.read_bytes()):
        record = wandb_internal_pb2.Record()
        record.ParseFromString(data)
        kind = record.WhichOneof("record_type")
        if kind == "run":
            run.name, run.project = record.run.display_name, record.run.project
            run.config |= _values(record.run.config.update)
        elif kind == "history":
            run.history.append(_values(record.history.item))
        elif kind == "summary":
            run.summary |= _values(record.summary.update)
        elif kind == "exit":
            run.is_finished = record.exit.exit_code == 0
    return run


def _values(items: Any) -> dict[str, Any]:
    return {item.key or item.nested_key[0]: json.loads(item.value_json) for item in items}


def _records(data: bytes) -> Iterator[bytes]:
    assert data.startswith(b":W&B")
    place, parts = _HEAD, b""
    while place < len(data):
        left = _BLOCK - place % _BLOCK
        if left < _HEAD:
            place += left
            continue
        _, length, kind = struct.unpack("<IHB", data[place : place + _HEAD])
        parts += data[place + _HEAD : place + _HEAD + length]
        place += _HEAD + length
        if kind in (_WHOLE, _LAST):
            yield parts
            parts = b""
