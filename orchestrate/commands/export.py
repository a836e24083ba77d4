"""Command ``export``: results as a file for other programs, with a manifest of their origin."""

from __future__ import annotations

import argparse
from pathlib import Path

from orchestrate.cli_parser import UsageError
from orchestrate.commands.command import Command
from orchestrate.commands.filtering import add_filters, chosen
from orchestrate.commands.output import say, say_json
from orchestrate.errors import ExitCode
from orchestrate.export.wanted import FORMATS, KINDS, Export
from orchestrate.store import Reader


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "kind",
        choices=KINDS,
        help="curves (a row for each step), trials (a row for each trial) or trajectories (states "
        "and inputs; with npz also the final parameters)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="PATH", help="file to write")
    parser.add_argument(
        "--format", choices=FORMATS, help="csv, parquet or npz (as the name of the file ends)"
    )
    add_filters(parser)


def run(arguments: argparse.Namespace) -> ExitCode:
    """Write the file and its manifest."""
    from orchestrate.export.exporting import export  # its libraries would slow every command

    wanted = Export(
        kind=arguments.kind,
        format=arguments.format or _format_of(arguments.out),
        out=arguments.out,
        filters={"env": arguments.env, "policy": arguments.policy},
    )
    with Reader.open(arguments.db) as reader, reader.moment() as moment:
        document = export(moment, chosen(moment, arguments), wanted)
    if arguments.json:
        say_json(document)
    else:
        size = f"{document['rows']:,} rows" if "rows" in document else "matrices"
        say(f"{wanted.out}: {size}, {document['bytes']:,} bytes; from where: {wanted.manifest}")
    return ExitCode.DONE


def _format_of(path: Path) -> str:
    ending = path.suffix.removeprefix(".").lower()
    if ending not in FORMATS:
        raise UsageError(
            f"The name of {path} does not say its format, {', '.join(FORMATS)} are known: give "
            f"--format or such an ending."
        )
    return ending


COMMAND = Command("export", "write curves, trials or trajectories to a file", add_arguments, run)
