"""Command ``export``: results as a file for other programs, with a manifest of their origin."""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dopt import __version__
from dopt.errors import DoptError
from orchestrate.commands.command import Command, add_filters, answer, chosen
from orchestrate.commands.results import counts
from orchestrate.errors import ExitCode, without_password
from orchestrate.files import whole
from orchestrate.program import UsageError, check_removed, path
from orchestrate.store import ConfigRow, Reader
from orchestrate.store.records import now

KINDS = ("curves", "trials", "trajectories", "assessments")
"""Exports that are one file."""

FORMATS = ("csv", "parquet")

_WRITERS = "SELECT DISTINCT config_key, launch_id FROM v_trial WHERE launch_id IS NOT NULL"


class ExportError(DoptError):
    """Empty selection, or file that cannot be written."""


@dataclass(frozen=True)
class Export:
    """Request of an export: one of ``KINDS`` in one of ``FORMATS``, with filters."""

    kind: str
    format: str
    out: Path
    filters: Mapping[str, Sequence[str]]

    @property
    def manifest(self) -> Path:
        return self.out.with_name(f"{self.out.name}.manifest.json")


def export(reader: Reader, configs: Sequence[ConfigRow], wanted: Export) -> dict[str, Any]:
    """Write the file, and after it its manifest; return what the manifest says.

    Both appear whole or not at all. ``reader`` sees the moment of ``configs``. Raises
    ``ExportError``, or ``OutputError`` if they cannot be written.
    """
    _expect_trials(reader, configs, wanted)
    with whole(wanted.manifest) as manifest, whole(wanted.out) as out:
        content = _write(reader, configs, wanted, out)
        about = {"file": wanted.out.name, "bytes": out.stat().st_size, "sha256": digest(out)}
        document = {
            "kind": wanted.kind,
            "format": wanted.format,
            **about,
            **content,
            **provenance(reader, configs, wanted.filters),
        }
        manifest.write_text(json.dumps(document, indent=2) + "\n")
    return document


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write(
    reader: Reader, configs: Sequence[ConfigRow], wanted: Export, out: Path
) -> dict[str, Any]:
    from orchestrate import export as tables  # Arrow: other commands do without it

    stream = tables.STREAMS[wanted.kind](reader, configs)
    columns = {field.name: str(field.type) for field in stream.schema}
    with closing(stream.batches):  # after an error, before the database
        return {"rows": tables.WRITERS[wanted.format](out, stream), "columns": columns}


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


def provenance(
    reader: Reader, configs: Sequence[ConfigRow], filters: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Return database, selection, configurations and launches, without passwords."""
    keys = {config.config_key for config in configs}
    writers = {row.launch_id for row in reader.rows(_WRITERS) if row.config_key in keys}
    launches = [asdict(one) for one in reader.launches() if one.launch_id in writers]
    return {
        "written": now(),
        "program": f"dopt {__version__}",
        "database": reader.safe_url,
        "schema_version": reader.schema_version(),
        "filters": {name: list(values) for name, values in filters.items()},
        "trials": dict(counts(configs)),
        "missing_values": "empty in csv, null in parquet: a loss that is not finite",
        "configs": {config.config_key: dict(config.config) for config in configs},
        "launches": [_public(launch) for launch in launches],
    }


def _public(launch: Mapping[str, Any]) -> dict[str, Any]:
    words = {name: [*map(without_password, launch[name])] for name in ("argv", "overrides")}
    return {**launch, **words}


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
    wanted = Export(
        kind=arguments.kind,
        format=arguments.format or _format_of(out),
        out=out,
        filters={"env": arguments.env, "policy": arguments.policy},
    )
    with Reader.open(arguments.db) as reader, reader.moment() as moment:
        document = export(moment, chosen(moment, arguments), wanted)
    size = f"{document['rows']:,} rows" if "rows" in document else "matrices"
    line = f"{out}: {size}, {document['bytes']:,} bytes; from where: {wanted.manifest}"
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
