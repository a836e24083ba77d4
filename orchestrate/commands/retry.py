"""Command ``retry STATUS``: put trials without a result back to pending."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence

from orchestrate.commands.command import Command
from orchestrate.commands.filtering import add_filters
from orchestrate.commands.output import say, say_json
from orchestrate.commands.trials import ListedTrial, listed, the_one
from orchestrate.errors import ExitCode
from orchestrate.store import RETRIED, Reader, Store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("status", choices=list(RETRIED), help=", ".join(RETRIED))
    add_filters(parser)
    parser.add_argument("--trial", nargs="+", default=(), metavar="KEY", help="only these trials")
    parser.add_argument("--dry-run", action="store_true", help="only print the number of trials")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Put the trials back to pending, so that the next launch of their grid runs them."""
    with Reader.open(arguments.db) as reader, reader.moment() as moment:
        trials = _trials(moment, arguments)
    statuses = RETRIED[arguments.status]
    keys = [row.trial_key for row in trials if row.status in statuses]
    left = Counter(row.status for row in trials if row.status not in statuses)
    if not arguments.dry_run and keys:
        with Store.open(arguments.db) as store:
            count = store.retry(arguments.status, keys)
    else:
        count = len(keys)
    if arguments.json:
        say_json({"dry_run": arguments.dry_run, "trials": count, "keys": keys, "left": left})
    else:
        say(_sentence(arguments, count, left))
    return ExitCode.DONE


def _trials(reader: Reader, arguments: argparse.Namespace) -> Sequence[ListedTrial]:
    """Return the trials that the options select, whatever their status."""
    rows = listed(reader, arguments)
    if not arguments.trial:
        return rows
    named = {the_one(rows, start).trial_key for start in arguments.trial}
    return [row for row in rows if row.trial_key in named]


def _sentence(arguments: argparse.Namespace, count: int, left: Counter[str]) -> str:
    kind = "unsuccessful" if arguments.status == "all" else arguments.status
    others = ", ".join(f"{number:,} {status}" for status, number in sorted(left.items()))
    rest = f" Left as they are: {others}." if others else ""
    if not count:
        return f"There is no {kind} trial to retry.{rest}"
    noun = f"{count:,} {kind} {'trial' if count == 1 else 'trials'}"
    if arguments.dry_run:
        return f"{noun} would wait to be run again; nothing was changed.{rest}"
    return (
        f"{noun} {'waits' if count == 1 else 'wait'} to be run again: the same launch command as "
        f"before runs them.{rest}"
    )


COMMAND = Command("retry", "let trials without a result run again", add_arguments, run)
