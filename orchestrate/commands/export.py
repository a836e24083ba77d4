"""Command ``export``: results as a file or a folder for other programs, with their origin."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from orchestrate.commands.command import Command, add_filters, answer, chosen
from orchestrate.errors import ExitCode
from orchestrate.export.exporting import FORMATS, KINDS, BundleExport, Export, export
from orchestrate.program import UsageError, path
from orchestrate.store import Reader

_NO_LICENSE = "unknown"
_LICENSE = re.compile(r"[a-z0-9][a-z0-9.+-]*")


def _add_export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "kind",
        choices=(*KINDS, "bundle"),
        help="a file: curves (a row for each step), trials (a row for each trial), trajectories "
        "(states and inputs; with npz also the final parameters) or assessments; a folder: bundle "
        "(all tables as Parquet, which merge imports into a database)",
    )
    parser.add_argument(
        "path", nargs="?", type=path("PATH"), metavar="PATH", help="file or folder to write"
    )
    parser.add_argument("--out", type=path("--out"), metavar="PATH", help="the same, as an option")
    parser.add_argument(
        "--format", choices=FORMATS, help="csv, parquet or npz (as the name of the file ends)"
    )
    parser.add_argument(
        "--license",
        metavar="ID",
        help="licence of the data for the card of a bundle, such as cc-by-4.0 (default: "
        f"{_NO_LICENSE})",
    )
    add_filters(parser)


def _run_export(arguments: argparse.Namespace) -> ExitCode:
    """Write the file and its manifest, or the folder."""
    out = _target(arguments)
    to = _to_bundle if arguments.kind == "bundle" else _to_file
    document = to(arguments, out)
    return answer(arguments, document, _line(arguments.kind, out, document))


def _target(arguments: argparse.Namespace) -> Path:
    given = [one for one in (arguments.path, arguments.out) if one is not None]
    if len(given) != 1:
        raise UsageError(
            f"{'Two paths are' if given else 'No path is'} given to write to, one is expected: "
            f"write export {arguments.kind} PATH."
        )
    out: Path = given[0]
    return out


def _to_file(arguments: argparse.Namespace, out: Path) -> dict[str, Any]:
    if arguments.license is not None:
        raise UsageError("--license is for the card of a bundle, not for a file: leave it out.")
    wanted = Export(
        kind=arguments.kind,
        format=arguments.format or _format_of(out),
        out=out,
        filters={"env": arguments.env, "policy": arguments.policy},
    )
    with Reader.open(arguments.db) as reader, reader.moment() as moment:
        return export(moment, chosen(moment, arguments), wanted)


def _to_bundle(arguments: argparse.Namespace, out: Path) -> dict[str, Any]:
    from orchestrate.export.bundle import write_bundle  # Arrow would slow every command

    if arguments.format is not None:
        raise UsageError("--format is for files, but a bundle is a folder: leave it out.")
    wanted = BundleExport(
        out=out,
        filters={"env": arguments.env, "policy": arguments.policy},
        license=_license(arguments),
    )
    with Reader.open(arguments.db) as reader, reader.moment() as moment:
        return write_bundle(moment, chosen(moment, arguments), wanted)


def _license(arguments: argparse.Namespace) -> str:
    given = arguments.license
    if given is not None and not _LICENSE.fullmatch(given):
        raise UsageError(
            f"--license is {given!r}, an identifier in lower case is expected: give one such as "
            f"cc-by-4.0 or mit."
        )
    return given or _NO_LICENSE


def _line(kind: str, out: Path, document: dict[str, Any]) -> str:
    if kind == "bundle":
        return f"{out}: {document['n_trials']:,} trials, {document['bytes']:,} bytes"
    size = f"{document['rows']:,} rows" if "rows" in document else "matrices"
    manifest = out.with_name(f"{out.name}.manifest.json")
    return f"{out}: {size}, {document['bytes']:,} bytes; from where: {manifest}"


def _format_of(path: Path) -> str:
    ending = path.suffix.removeprefix(".").lower()
    if ending not in FORMATS:
        raise UsageError(
            f"The name of {path} does not say its format, {', '.join(FORMATS)} are known: give "
            f"--format or such an ending."
        )
    return ending


EXPORT_COMMAND = Command(
    "export", "write results to a file or a bundle", _run_export, _add_export_arguments
)
