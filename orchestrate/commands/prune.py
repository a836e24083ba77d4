"""Command ``prune``: delete the trials that a rule of retention selects."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from datetime import UTC, datetime, timedelta

from orchestrate.cli_parser import UsageError, length_of_time
from orchestrate.commands.command import PROGRAM, Command
from orchestrate.commands.filtering import add_filters, chosen
from orchestrate.commands.output import say, say_json
from orchestrate.errors import ExitCode
from orchestrate.store import Prunable, Reader, Store, prunable
from orchestrate.store.serialization import utc_text

_COLUMN = "trial_key"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "sql",
        nargs="?",
        metavar="SQL",
        help=f"one SELECT with the column {_COLUMN}: only the trials in it",
    )
    add_filters(parser)
    parser.add_argument(
        "--older-than",
        type=length_of_time("--older-than"),
        metavar="TIME",
        help="only trials that ended so long ago, such as 90d",
    )
    act = parser.add_mutually_exclusive_group(required=True)
    act.add_argument("--dry-run", action="store_true", help="only print what would be deleted")
    act.add_argument("--yes", action="store_true", help="delete the trials")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Delete the trials, all that is stored of them, and configurations without a trial."""
    if not (arguments.sql or arguments.env or arguments.policy or arguments.older_than):
        raise UsageError(
            "prune has no rule, one is expected: give a SELECT, --env, --policy or --older-than."
        )
    with Reader.open(arguments.db) as reader:
        found = _found(reader, arguments)
    deleted = 0
    if arguments.yes and found.keys:
        with Store.open(arguments.db) as store:
            deleted = store.prune(found.keys)
    if arguments.json:
        say_json({**asdict(found), "dry_run": arguments.dry_run, "deleted": deleted})
    else:
        say(_sentence(found, deleted, dry=arguments.dry_run))
    return ExitCode.DONE


def _found(reader: Reader, arguments: argparse.Namespace) -> Prunable:
    keys = _keys(reader, arguments.sql) if arguments.sql else None
    before = None
    if arguments.older_than is not None:
        before = utc_text(datetime.now(UTC) - timedelta(seconds=arguments.older_than))
    with reader.moment() as moment:
        configs = {config.config_key for config in chosen(moment, arguments)}
        return prunable(moment, configs, keys, before)


def _keys(reader: Reader, sql: str) -> set[str]:
    table = reader.query(sql)
    if _COLUMN not in table.columns:
        raise UsageError(
            f"The query has the columns {', '.join(table.columns)}, {_COLUMN} is expected: select "
            f"it, such as \"SELECT {_COLUMN} FROM v_trial WHERE status = 'failed'\"."
        )
    place = table.columns.index(_COLUMN)
    return {row[place] for row in table}


def _sentence(found: Prunable, deleted: int, *, dry: bool) -> str:
    left = f" {found.left:,} more stay: they have no outcome, or their launch runs."
    rest = left if found.left else ""
    if not found.keys:
        return f"There is no trial to delete.{rest}"
    kinds = ", ".join(f"{n:,} {status}" for status, n in sorted(found.statuses.items()))
    size = f"{found.steps:,} steps, about {found.size / 1e6:,.1f} MB"
    if dry:
        trials = f"{len(found.keys):,} trials would be deleted ({kinds})"
        return f"{trials}: {size}; nothing was changed.{rest}"
    space = f"{PROGRAM} vacuum gives the space back"
    return f"{deleted:,} trials were deleted ({kinds}): {size}; {space}.{rest}"


COMMAND = Command("prune", "delete old or unwanted trials", add_arguments, run)
