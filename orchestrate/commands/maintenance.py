"""Commands that check or change a whole database, from ``merge`` to ``prune``."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime, timedelta

from dopt.errors import given_path
from orchestrate.commands import Command, add_filters, answer, chosen, plain, say_json, show
from orchestrate.commands.results import ListedTrial, listed, the_one
from orchestrate.errors import ExitCode
from orchestrate.program import UsageError, length_of_time, path
from orchestrate.store import RETRIED, Reader, Store
from orchestrate.store.backend import file_url
from orchestrate.store.maintenance import (
    Finding,
    Prunable,
    Upgrade,
    back_up,
    examine,
    merge_folder,
    prunable,
    upgrade,
)
from orchestrate.store.merge import Merged, TrialName, merge
from orchestrate.store.records import utc_text

MAX_LISTED = 10
"""Trials of a kind that are listed; the JSON has all of them."""


def _add_merge_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "other",
        metavar="OTHER",
        help="file or URL of the other database, or folder of SQLite files",
    )


def _run_merge(arguments: argparse.Namespace) -> ExitCode:
    """Merge and print the counts; exit code 1 if trials that have an outcome were left out."""
    merged = _merge(arguments.db, arguments.other)
    document = {**asdict(merged), "changed": merged.changed}
    answer(arguments, document, "\n".join(_merge_lines(merged)))
    refused = merged.conflicts or merged.incomplete or merged.contradictory
    return ExitCode.SOME_FAILED if refused else ExitCode.DONE


def _merge(url: str, other: str) -> Merged:
    if "://" in other:
        return merge(url, other)
    place = given_path(other, "OTHER", UsageError)
    if place.is_dir():
        return merge_folder(url, place)
    return merge(url, file_url(place))


def _merge_lines(merged: Merged) -> list[str]:
    added = ", ".join(f"{count:,} {status}" for status, count in sorted(merged.added.items()))
    lines = [f"copied {sum(merged.added.values()):,} trials{f' ({added})' if added else ''}"]
    told = {
        f"{merged.identical:,} exist here with equal numbers": merged.identical,
        f"{merged.kept:,} failed there and have an outcome here": merged.kept,
        f"{merged.running:,} are running here": merged.running,
    }
    lines += [line for line, count in told.items() if count]
    lines += _listed("have different numbers here and were not copied", merged.conflicts)
    lines += _listed("are incomplete there and were not copied", merged.incomplete)
    what = "contradict their keys or the shapes of their arrays there and were not copied"
    lines += _listed(what, merged.contradictory)
    return lines


def _listed(what: str, trials: Sequence[TrialName]) -> list[str]:
    if not trials:
        return []
    rest = [f"  and {len(trials) - MAX_LISTED:,} more"] if len(trials) > MAX_LISTED else []
    names = [f"  {one.trial_key[:12]}  {one.env} {one.policy} seed {one.seed}" for one in trials]
    return [f"{len(trials):,} {what}:", *names[:MAX_LISTED], *rest]


MERGE_COMMAND = Command(
    "merge", "copy the trials of another database", _run_merge, _add_merge_arguments
)


def _run_doctor(arguments: argparse.Namespace) -> ExitCode:
    """Print the findings; exit code 1 if results cannot be trusted."""
    findings = examine(arguments.db)
    if arguments.json:
        say_json([asdict(one) for one in findings])
    else:
        show(*map(plain, _doctor_lines(findings)))
    errors = any(one.severity == "error" for one in findings)
    return ExitCode.SOME_FAILED if errors else ExitCode.DONE


def _doctor_lines(findings: list[Finding]) -> list[str]:
    if not findings:
        return ["Nothing is wrong."]
    counts = Counter(one.severity for one in findings)
    total = ", ".join(f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in counts.items())
    lines = [f"{one.severity}: {one.sentence}.\n  {one.advice}." for one in findings]
    return [*lines, total]


DOCTOR_COMMAND = Command(
    "doctor", "check for damage, incomplete results, wrong keys and stale claims", _run_doctor
)


def _add_upgrade_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--no-backup", action="store_true", help="do not make a backup first")


def _run_upgrade(arguments: argparse.Namespace) -> ExitCode:
    """Upgrade the database in one transaction, after a backup."""
    done = upgrade(arguments.db, backup=not arguments.no_backup)
    return answer(arguments, {**asdict(done), "changed": done.changed}, _upgrade_sentence(done))


def _upgrade_sentence(done: Upgrade) -> str:
    if done.before == done.after:
        found = f"{done.safe_url} has schema {done.after}, the newest"
        packed = f"the curves of {done.packed:,} trials were packed"
        return f"{found}; {packed}." if done.packed else f"{found}: there is nothing to do."
    if done.before is None:
        return f"{done.safe_url} was empty and has schema {done.after} now."
    copy = f"a backup is in the file {done.backup}" if done.backup else "no backup was made"
    return f"{done.safe_url} went from schema {done.before} to {done.after}; {copy}."


UPGRADE_COMMAND = Command(
    "upgrade",
    "migrate an older database to the newest schema",
    _run_upgrade,
    _add_upgrade_arguments,
)


def _add_backup_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file",
        type=path("FILE"),
        metavar="FILE",
        help="new file: a database of SQLite, or an archive of PostgreSQL for pg_restore",
    )


def _run_backup(arguments: argparse.Namespace) -> ExitCode:
    """Write the file and print its size."""
    size = back_up(arguments.db, arguments.file)
    document = {"file": str(arguments.file), "bytes": size}
    return answer(arguments, document, f"{arguments.file}: {size:,} bytes")


BACKUP_COMMAND = Command(
    "backup", "copy the database to a file", _run_backup, _add_backup_arguments
)


def _add_retry_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("status", choices=list(RETRIED), help=", ".join(RETRIED))
    add_filters(parser)
    parser.add_argument("--trial", nargs="+", default=(), metavar="KEY", help="only these trials")
    parser.add_argument("--dry-run", action="store_true", help="only print the number of trials")


def _run_retry(arguments: argparse.Namespace) -> ExitCode:
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
    document = {"dry_run": arguments.dry_run, "trials": count, "keys": keys, "left": left}
    return answer(arguments, document, _retry_sentence(arguments, count, left))


def _trials(reader: Reader, arguments: argparse.Namespace) -> Sequence[ListedTrial]:
    """Return the trials that the options select, whatever their status."""
    rows = listed(reader, arguments)
    if not arguments.trial:
        return rows
    named = {the_one(rows, start).trial_key for start in arguments.trial}
    return [row for row in rows if row.trial_key in named]


def _retry_sentence(arguments: argparse.Namespace, count: int, left: Counter[str]) -> str:
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


RETRY_COMMAND = Command(
    "retry", "let trials without a result run again", _run_retry, _add_retry_arguments
)


_COLUMN = "trial_key"


def _add_prune_arguments(parser: argparse.ArgumentParser) -> None:
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


def _run_prune(arguments: argparse.Namespace) -> ExitCode:
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
    document = {**asdict(found), "dry_run": arguments.dry_run, "deleted": deleted}
    return answer(arguments, document, _prune_sentence(found, deleted, dry=arguments.dry_run))


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


def _prune_sentence(found: Prunable, deleted: int, *, dry: bool) -> str:
    left = f" {found.left:,} more stay: they have no outcome, or their launch runs."
    rest = left if found.left else ""
    if not found.keys:
        return f"There is no trial to delete.{rest}"
    kinds = ", ".join(f"{n:,} {status}" for status, n in sorted(found.statuses.items()))
    size = f"{found.steps:,} steps, about {found.size / 1e6:,.1f} MB"
    if dry:
        trials = f"{len(found.keys):,} trials would be deleted ({kinds})"
        return f"{trials}: {size}; nothing was changed.{rest}"
    return f"{deleted:,} trials were deleted ({kinds}): {size}.{rest}"


PRUNE_COMMAND = Command("prune", "delete old or unwanted trials", _run_prune, _add_prune_arguments)
