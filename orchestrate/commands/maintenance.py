"""Commands on a grid, ``status`` and ``work``, and on a database: ``merge`` to ``prune``."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from dopt.errors import counted, given_path
from orchestrate.commands import Command, add_filters, answer, chosen, plain, say, say_json, show
from orchestrate.commands.results import (
    MAX_KINDS,
    ListedTrial,
    Status,
    gather,
    grid_table,
    listed,
    seconds_since,
    the_one,
)
from orchestrate.errors import ExitCode, without_password
from orchestrate.program import UsageError, as_started, length_of_time, path, positive, tell
from orchestrate.program import say as say_still
from orchestrate.runner.progress import duration
from orchestrate.store import RETRIED, FailureKind, LaunchRow, Reader, Store
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
from orchestrate.store.records import STATES, utc_text

MAX_ROWS = 60
"""Rows of the table without --all."""


def _add_status_arguments(parser: argparse.ArgumentParser) -> None:
    add_filters(parser)
    parser.add_argument(
        "--all", action="store_true", help=f"a row for each configuration, also above {MAX_ROWS}"
    )


def _run_status(arguments: argparse.Namespace) -> ExitCode:
    """Print the status."""
    with Reader.open(arguments.db) as reader, reader.moment() as moment:
        status = gather(moment, chosen(moment, arguments))
    if arguments.json:
        say_json(document(status, reader.safe_url))
    elif not status.configs:
        say(f"{reader.safe_url} holds no trials yet: run a launch that writes to it.")
    else:
        show(*parts(status, len(status.configs) if arguments.all else MAX_ROWS))
    return ExitCode.DONE


STATUS_COMMAND = Command(
    "status", "show progress, failures and running launches", _run_status, _add_status_arguments
)


WORK = as_started("python -m orchestrate work")
_NAMES = ("env", "policy", "model", "learner", "width", "depth", "horizon", "dt", "gamma")
_CONFIG = ("config_key", *_NAMES, "n", *(f"n_{state}" for state in STATES))
_LAUNCH = ("launch_id", "alive", "host", "pid", "started", "argv")
_FAILURE = ("cause", "type", "message", "trials", "attempts", "last_line", "place")
_MAX_EXPLORATIONS = 20  # the newest
_MAX_PLACES = 4
_MAX_LINE = 200  # characters of a line of a traceback


def summary(status: Status) -> str:
    """Return the counts, the rate and the estimated remaining time on one line."""
    counts, total = status.counts, status.total
    words = [f"{total - status.left:,} of {total:,} trials have an outcome"]
    words += [f"{counts[name]:,} {name}" for name in counts if counts[name]]
    if status.rate:
        words.append(f"{status.rate:.1f}/s")
    if status.seconds_left is not None:
        words.append(f"{duration(status.seconds_left)} left")
    return " · ".join(words)


def parts(status: Status, max_rows: int) -> Iterator[RenderableType]:
    """Yield the grid in at most ``max_rows`` rows, the failures and the launches."""
    yield grid_table(status.configs, max_rows)
    yield Text(f"\n{summary(status)}", style="bold")
    if status.mixed:
        yield Text(
            f"{counted(len(status.mixed), 'configuration')} with results of different code "
            f"(the first is {status.mixed[0][:12]}): python -m orchestrate doctor",
            style="yellow",
        )
    if status.explorations:
        yield Text("\nExplorations", style="bold")
        for one in status.explorations[-_MAX_EXPLORATIONS:]:
            name = f"{one.env}, {one.label}, seed {one.seed}"
            yield plain(f"  {one.trial_key[:12]}  {name}: {one.state}")
    if status.failures:
        yield Text("\nFailures", style="bold red")
        yield from map(_failure, status.failures[:MAX_KINDS])
        if len(status.failures) > MAX_KINDS:
            yield Text(f"  and {len(status.failures) - MAX_KINDS:,} other kinds")
    detached = status.detached if status.left else ()
    if status.launches or detached:
        yield Text("\nLaunches", style="bold")
        for launch in detached:
            where = f"{launch.launch_id} on {launch.host}, {launch.started[:19]}Z"
            yield Text(f"  {where}: registered a grid for workers")
        yield from (_launch(launch, bool(status.left)) for launch in status.launches)
    if status.left and not status.launches:
        again = f"start workers with {WORK}" if detached else "run the same launch command again"
        yield Text(f"\nNo {'worker' if detached else 'launch'} is running: {again} to continue.")


def _failure(kind: FailureKind) -> Text:
    places = sorted(f"{env}/{policy}" for env, policy in kind.places)
    more = [f"and {len(places) - _MAX_PLACES} other places"] if len(places) > _MAX_PLACES else []
    text = Text(f"  {counted(kind.trials, 'trial')} ({counted(kind.attempts, 'attempt')}), ")
    text.append(kind.cause, style="red")
    text.append(f": {', '.join([*places[:_MAX_PLACES], *more])}")
    last = kind.last_line or f"{kind.type or ''}: {kind.message or ''}".strip(": ")
    lines = [kind.message] if kind.message and kind.message not in last else []
    for line in filter(None, [*lines, last, kind.place and f"at {kind.place}"]):
        text.append("\n      ").append(plain(_first_line(line)))
    return text


def _launch(launch: LaunchRow, unfinished: bool) -> Text:
    age = duration(max(0.0, seconds_since(launch.started, datetime.now(UTC))))
    since = f"{launch.started[:19]}Z"
    where = f"  {launch.launch_id} on {launch.host}, process {launch.pid}, since {since}"
    worker = launch.kind == "worker"
    if launch.alive:
        return Text(f"{where}: {'worker, ' if worker else ''}alive for {age}")
    hint = "run the same launch command again to continue"
    if worker:
        hint = "other workers take its trials"
    dead = Text(f"{where}: ").append("dead", style="red")
    return dead.append(f"; {hint}") if unfinished else dead


def document(status: Status, database: str) -> dict[str, Any]:
    """Return the status as a JSON document."""
    launches = [{name: getattr(one, name) for name in _LAUNCH} for one in status.launches]
    for launch in launches:
        launch["argv"] = [without_password(word) for word in launch["argv"]]
    return {
        "database": database,
        "trials": {"all": status.total, **status.counts},
        "complete": not status.left,
        "per_second": status.rate,
        "seconds_left": status.seconds_left,
        "configs": [{name: getattr(one, name) for name in _CONFIG} for one in status.configs],
        "failures": [
            {**{name: getattr(kind, name) for name in _FAILURE}, "places": sorted(kind.places)}
            for kind in status.failures
        ],
        "launches": launches,
        "detached": [one.launch_id for one in status.detached],
        "explorations": [asdict(one) for one in status.explorations],
        "mixed_code": list(status.mixed),
    }


def _first_line(text: str) -> str:
    line = text.strip().splitlines()[0] if text.strip() else ""
    return line if len(line) <= _MAX_LINE else f"{line[: _MAX_LINE - 1]}…"


def _add_work_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--until",
        type=length_of_time("--until"),
        metavar="TIME",
        help="hold nothing after this time from now, such as 55m, 1h30m or 90s (default: run until "
        "no trial is left)",
    )
    parser.add_argument(
        "--processes",
        type=positive("--processes", int),
        metavar="N",
        help="trials at once (default: one for each core that this process may use)",
    )
    more = "run a trial that exceeds --memory-gib once more, with so many times as much"
    lost = "seconds for which a worker that is lost keeps its trials on PostgreSQL"
    for option, default, shown, text in (
        ("--timeout", 3600.0, None, "seconds that a trial may take"),
        ("--memory-gib", None, "GIB", "memory of one process"),
        ("--retry-memory", None, "FACTOR", more),
        ("--lease", 60.0, None, lost),
    ):
        number = positive(option, float)
        parser.add_argument(option, type=number, default=default, metavar=shown, help=text)


def _run_work(arguments: argparse.Namespace) -> ExitCode:
    """Run trials until none is left, the time is over, or a signal comes."""
    from orchestrate.runner.start import Output
    from orchestrate.runner.worker import run_worker

    names = ("processes", "timeout", "memory_gib", "retry_memory", "lease")
    given = {name: getattr(arguments, name) for name in names}
    output = Output(_to_stderr if arguments.json else say_still, _to_stderr, sys.stderr)
    code = run_worker(arguments.db, output, seconds=arguments.until, **given)
    if arguments.json:
        say_json({"exit_code": code.value, "complete": code in (0, ExitCode.SOME_FAILED)})
    return code


def _to_stderr(line: str) -> None:
    tell(sys.stderr, f"{without_password(line)}\n")


WORK_COMMAND = Command(
    "work", "run registered trials on this machine", _run_work, _add_work_arguments
)


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
    copied = counted(sum(merged.added.values()), "trial")
    lines = [f"copied {copied}{f' ({added})' if added else ''}"]
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
