"""One export: rows out of the database, into a file, with a manifest of where they come from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from orchestrate.export import matrices, streams, tables
from orchestrate.export.manifest import provenance
from orchestrate.export.wanted import Export, ExportError
from orchestrate.files import whole
from orchestrate.store import ConfigRow, Reader

_STREAMS: dict[str, Callable[[Reader, Sequence[ConfigRow]], streams.Stream]] = {
    "curves": streams.curves,
    "trials": streams.trials,
    "trajectories": streams.trajectories,
    "assessments": streams.assessments,
}
_MATRICES: dict[
    str, Callable[[Reader, Sequence[ConfigRow]], Generator[matrices.Named, None, None]]
] = {
    "curves": matrices.curves,
    "trials": matrices.trials,
    "trajectories": matrices.trajectories,
    "assessments": matrices.assessments,
}
_WRITERS = {"csv": tables.write_csv, "parquet": tables.write_parquet}


def export(reader: Reader, configs: Sequence[ConfigRow], wanted: Export) -> dict[str, Any]:
    """Write the file, and after it its manifest; return what the manifest says.

    Both appear whole or not at all. ``reader`` sees one moment, that of ``configs``. Raises
    ``ExportError``, or ``OutputError`` if they cannot be written.
    """
    _expect_trials(reader, configs, wanted)
    with whole(wanted.manifest) as manifest, whole(wanted.out) as out:
        content = _write(reader, configs, wanted, out)
        about = {"file": wanted.out.name, "bytes": out.stat().st_size, "sha256": _hash(out)}
        document = {
            "kind": wanted.kind,
            "format": wanted.format,
            **about,
            **content,
            **provenance(reader, configs, wanted.filters),
        }
        manifest.write_text(json.dumps(document, indent=2) + "\n")
    return document


def _write(
    reader: Reader, configs: Sequence[ConfigRow], wanted: Export, out: Path
) -> dict[str, Any]:
    # After an error the cursors must close before the database does.
    if wanted.format == "npz":
        with closing(_MATRICES[wanted.kind](reader, configs)) as arrays:
            return {"arrays": matrices.write(out, arrays)}
    stream = _STREAMS[wanted.kind](reader, configs)
    columns = {field.name: str(field.type) for field in stream.schema}
    with closing(stream.batches):
        return {"rows": _WRITERS[wanted.format](out, stream), "columns": columns}


def _expect_trials(reader: Reader, configs: Sequence[ConfigRow], wanted: Export) -> None:
    if not configs:
        raise ExportError(
            f"{reader.safe_url} holds no trials yet: run a launch that writes to it first."
        )
    if wanted.kind == "assessments" and not any(reader.measures(c.config_key) for c in configs):
        raise ExportError(
            "No trial of these was assessed, so that there are no assessments to export: run them "
            "with task=control."
        )
    if wanted.kind != "trials" and not any(config.n_done + config.n_diverged for config in configs):
        raise ExportError(
            f"No trial of these is done yet, so that there are no {wanted.kind} to export: run "
            f"the launch, or see status."
        )


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
