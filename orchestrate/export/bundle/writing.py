"""Bundle of results: tables, views, card, provenance and checksums in one folder."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from orchestrate.export.bundle import parquet
from orchestrate.export.bundle.card import card
from orchestrate.export.bundle.rows import Source
from orchestrate.export.bundle.views import VIEWS_FILE, views_sql
from orchestrate.export.manifest import provenance
from orchestrate.export.wanted import ExportError, FolderExport
from orchestrate.files import whole_folder
from orchestrate.redaction import without_password
from orchestrate.store import ConfigRow, Reader
from orchestrate.store.bundle import (
    KIND,
    PROVENANCE,
    TABLES,
    arrow_schema,
    file_name,
    write_checksums,
)

CARD = "README.md"

_LIBRARIES = ("numpy", "pyarrow", "sqlalchemy")


def write_bundle(
    reader: Reader, configs: Sequence[ConfigRow], wanted: FolderExport
) -> dict[str, Any]:
    """Write the folder, whole or not at all, in place of an earlier bundle; return its provenance.

    It holds all trials of the configurations, whatever their status. ``reader`` sees one moment,
    that of ``configs``. Raises ``ExportError``.
    """
    if not configs:
        raise ExportError(
            f"{reader.safe_url} holds no trials yet: run a launch that writes to it first."
        )
    with whole_folder(wanted.out, _is_bundle) as folder:
        rows = _write_tables(Source(reader, configs), folder)
        facts = _facts(reader, configs, wanted, rows)
        (folder / PROVENANCE).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
        (folder / VIEWS_FILE).write_text(views_sql(), encoding="utf-8")
        (folder / CARD).write_text(card(configs, rows, facts, wanted.license), encoding="utf-8")
        write_checksums(folder)
        return facts | {
            "n_trials": rows["trial"],
            "bytes": sum(path.stat().st_size for path in folder.iterdir()),
        }


def _write_tables(source: Source, folder: Path) -> dict[str, int]:
    """Return the number of rows of each table."""
    return {
        name: parquet.write(folder / file_name(name), arrow_schema(name), source.batches(name))
        for name in TABLES
    }


def _facts(
    reader: Reader, configs: Sequence[ConfigRow], wanted: FolderExport, rows: dict[str, int]
) -> dict[str, Any]:
    facts = provenance(reader, configs, wanted.filters)
    missing = "missing in the tables, NaN in the arrays of trajectory: a number that is not finite"
    return {
        "kind": KIND,
        "command": [without_password(word) for word in sys.argv],
        "versions": {
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in _LIBRARIES},
        },
        "license": wanted.license,
        "rows": rows,
        **facts,
        "missing_values": missing,
    }


def _is_bundle(folder: Path) -> bool:
    try:
        facts = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(facts, dict) and facts.get("kind") == KIND
