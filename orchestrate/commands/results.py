"""Commands that read results, ``query`` and ``show``; progress of a grid, one trial, as values."""

from __future__ import annotations

import argparse
import csv
import io
import math
import re
import shlex
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from orchestrate.commands import Command, add_filters, chosen, plain, say_json, show, table
from orchestrate.errors import ExitCode
from orchestrate.program import UsageError, integer, positive, tell
from orchestrate.store import (
    ConfigRow,
    ExplorationRow,
    FailureKind,
    LaunchRow,
    Reader,
    TrialReport,
    explorations,
    failure_kinds,
    trial_report,
)
from orchestrate.store import Table as Rows
from orchestrate.store.records import STATES, jsonable, utc_text

RATE_WINDOW_SECONDS = 300.0
"""Period over which the rate is averaged."""

_ENDED = """
SELECT c.config_key, a.launch_id, count(*) AS ended
FROM attempt a
JOIN trial r ON r.trial_id = a.trial_id
JOIN config c ON c.config_id = r.config_id
WHERE a.ended >= :since AND a.outcome IN ('done', 'diverged', 'failed')
GROUP BY c.config_key, a.launch_id
"""


@dataclass(frozen=True)
class Status:
    """Configurations of a grid with their failures and running launches.

    Attributes
    ----------
    launches
        Launches recorded as running, including dead ones.
    rate
        Trials per second of the living launches over the last minutes.
    detached
        Launches that registered a grid for workers and left.
    mixed
        Keys of configurations whose finished trials were run by different code.
    explorations
        Explorations that were saved; they count as done or diverged.
    """

    configs: Sequence[ConfigRow]
    failures: Sequence[FailureKind]
    launches: Sequence[LaunchRow]
    rate: float
    explorations: Sequence[ExplorationRow] = ()
    detached: Sequence[LaunchRow] = ()
    mixed: Sequence[str] = ()

    @property
    def counts(self) -> Counter[str]:
        """Number of trials in each state."""
        return counts(self.configs)

    @property
    def total(self) -> int:
        return self.counts.total()

    @property
    def left(self) -> int:
        """Trials without an outcome."""
        return self.counts["pending"] + self.counts["running"]

    @property
    def seconds_left(self) -> float | None:
        return self.left / self.rate if self.left and self.rate else None


def counts(configs: Iterable[ConfigRow]) -> Counter[str]:
    """Return the number of trials in each state."""
    total = Counter(dict.fromkeys(STATES, 0))
    for config in configs:
        total.update(config.counts)
    return total


MAX_KINDS = 10
"""Kinds of failures that are shown with a traceback, the commonest."""


def gather(reader: Reader, configs: Sequence[ConfigRow]) -> Status:
    """Return the status of the configurations, with tracebacks of the commonest failures.

    ``reader`` is the snapshot from which ``configs`` were read.
    """
    by_key = {config.config_key: config for config in configs}
    launches = reader.launches()
    running = [launch for launch in launches if launch.state == "running"]
    detached = [launch for launch in launches if launch.kind == "registration"]
    failures = failure_kinds(reader, by_key, MAX_KINDS)
    explored = [one for one in explorations(reader) if one.config_key in by_key]
    mixed = [key for key in reader.mixed_code() if key in by_key]
    rate = _rate(reader, by_key, running)
    return Status(configs, failures, running, rate, explored, detached, mixed)


def _rate(reader: Reader, by_key: dict[str, ConfigRow], running: Sequence[LaunchRow]) -> float:
    now = datetime.now(UTC)
    ended: Counter[int] = Counter()
    for row in reader.rows(_ENDED, since=utc_text(now - timedelta(seconds=RATE_WINDOW_SECONDS))):
        ended[row.launch_id] += row.ended if row.config_key in by_key else 0
    alive = (launch for launch in running if launch.alive)
    spans = {
        one.launch_id: min(RATE_WINDOW_SECONDS, max(1.0, seconds_since(one.started, now)))
        for one in alive
    }
    return math.fsum(ended[launch_id] / span for launch_id, span in spans.items())


def seconds_since(moment: str, now: datetime) -> float:
    """Return the seconds from a time of the database to ``now``."""
    return (now - datetime.fromisoformat(moment)).total_seconds()


DEFAULT_LIMIT = 1_000
DEFAULT_TIMEOUT_SECONDS = 60.0
_MAX_TEXT = 60  # characters of a value in a table


def _add_query_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sql", metavar="SQL", help="one SELECT; docs/database.md has examples")
    parser.add_argument("--csv", action="store_true", help="print comma-separated values")
    parser.add_argument(
        "--limit",
        type=positive("--limit", int),
        help=f"most rows ({DEFAULT_LIMIT:,} in a table, all of them as CSV or JSON)",
    )
    parser.add_argument(
        "--timeout",
        type=positive("--timeout", float),
        default=DEFAULT_TIMEOUT_SECONDS,
        metavar="SECONDS",
        help=f"end the query after this time ({DEFAULT_TIMEOUT_SECONDS:g})",
    )


def _run_query(arguments: argparse.Namespace) -> ExitCode:
    """Print the rows, and a note on the standard error if there are more."""
    if arguments.csv and arguments.json:
        raise UsageError("--csv and --json are two forms of one answer: leave one of them out.")
    whole = arguments.csv or arguments.json
    limit = arguments.limit or (None if whole else DEFAULT_LIMIT)
    with Reader.open(arguments.db) as reader:
        rows = reader.query(arguments.sql, limit, arguments.timeout)
    if arguments.json:
        say_json({"columns": rows.columns, "rows": [list(row) for row in rows], "cut": rows.cut})
    elif arguments.csv:
        _write_csv(rows)
    else:
        _show(rows)
    if rows.cut:
        more = "--limit N gives more" if whole else "--limit N gives more, --csv gives all"
        sys.stderr.write(f"note: only the first {len(rows):,} rows are shown, {more}.\n")
    return ExitCode.DONE


def _write_csv(rows: Rows) -> None:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(rows.columns)
    writer.writerows([jsonable(value) for value in row] for row in rows)
    tell(sys.stdout, out.getvalue(), exact=True)


def _show(rows: Rows) -> None:
    numbers = {
        name
        for i, name in enumerate(rows.columns)
        if all(isinstance(row[i], int | float | None) for row in rows)
    }
    result = table(rows.columns, numbers=numbers)
    for row in rows:
        result.add_row(*(plain(_text(value)) for value in row))
    show(result)


def _text(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, bytes | memoryview):
        return f"({len(value):,} bytes)"
    line = " ".join(str(jsonable(value)).split())
    return line if len(line) <= _MAX_TEXT else f"{line[: _MAX_TEXT - 1]}…"


QUERY_COMMAND = Command("query", "run a read-only SQL query", _run_query, _add_query_arguments)


_BYTES_PER_MIB = 2**20
_ATTEMPT = ("attempt", "launch", "outcome", "cause", "node", "ended", "wall s", "cpu s", "peak MiB")


def _add_show_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("trial", metavar="TRIAL", nargs="?", help="first digits of the trial's key")
    add_filters(parser)
    parser.add_argument("--width", type=integer("--width"), help="the trial of this width")
    parser.add_argument("--seed", type=integer("--seed"), help="the trial of this seed")


def _run_show(arguments: argparse.Namespace) -> ExitCode:
    """Print the one trial that the options select."""
    with Reader.open(arguments.db) as reader, reader.moment() as moment:
        rows = listed(moment, arguments, width=arguments.width, seed=arguments.seed)
        row = the_one(rows, arguments.trial)
        found = trial_report(moment, row.trial_id)
    if arguments.json:
        say_json(asdict(found))
    else:
        show(Text(describe(row), style="bold"), *_parts(found))
    return ExitCode.DONE


def _parts(found: TrialReport) -> Iterator[RenderableType]:
    yield _outcome(found)
    yield Text("\nConfiguration", style="bold")
    yield from _configuration(found.config)
    for launch in found.launches:
        yield from _launch(launch)
    if found.attempts:
        yield Text("\nAttempts", style="bold")
        yield _attempts(found)
    errors = [attempt for attempt in found.attempts if attempt["traceback"]]
    if errors:
        yield Text(f"\nTraceback of attempt {errors[-1]['attempt']}", style="bold red")
        yield plain(errors[-1]["traceback"].rstrip())


def _outcome(found: TrialReport) -> Text:
    trial = found.trial
    words = [found.exploration.state if found.exploration else trial["status"]]
    if trial["diverged_at"] is not None:
        words.append(f"at step {trial['diverged_at']:,}")
    words += [
        f"{name.replace('_', ' ')} {trial[name]:.6g}"
        for name in ("final_loss", "best_loss")
        if trial[name] is not None
    ]
    words += [
        f"{name} {value:.6g}" for name, value in found.beyond_limits.items() if value is not None
    ]
    if trial["error_type"] is not None:
        words.append(f"{trial['error_type']}: {trial['error_message']}")
    return plain(" · ".join(words))


def _configuration(config: Mapping[str, Any]) -> Iterator[Text]:
    scalars = {name: value for name, value in config.items() if not isinstance(value, Mapping)}
    sections = {name: value for name, value in config.items() if isinstance(value, Mapping)}
    for name, section in {**sections, "": scalars}.items():
        if section:
            words = " ".join(f"{key}={value}" for key, value in section.items())
            yield plain(f"  {name:<8} {words}")


def _launch(launch: Mapping[str, Any]) -> Iterator[Text]:
    yield Text(f"\nLaunch {launch['launch_id']}", style="bold")
    commit = launch["git_commit"] or "no repository"
    if launch["git_dirty"]:
        commit += f", with changes (diff {str(launch['git_diff_hash'])[:12]})"
    state = "dead" if launch["state"] == "running" and not launch["alive"] else launch["state"]
    until = f"to {launch['ended']}" if launch["ended"] else ""
    lines = {
        "command": shlex.join(launch["argv"]),
        "state": f"{state}, from {launch['started']} {until}".rstrip(),
        "host": f"{launch['host']}, process {launch['pid']}",
        "commit": commit,
        "versions": " ".join(f"{name}={value}" for name, value in launch["versions"].items()),
    }
    yield from (plain(f"  {name:<8} {value}") for name, value in lines.items())


def _attempts(found: TrialReport) -> Table:
    result = table(_ATTEMPT, numbers={"attempt", "launch", "wall s", "cpu s", "peak MiB"})
    for one in found.attempts:
        memory = one["peak_memory_bytes"]
        values = [
            *(one["attempt"], one["launch_id"], one["outcome"] or "running", one["cause"]),
            *(one["node"], (one["ended"] or "")[:19]),
            *(_number(one["wall_seconds"]), _number(one["cpu_seconds"])),
            _number(memory / _BYTES_PER_MIB if memory is not None else None),
        ]
        result.add_row(*(plain("-" if value in (None, "") else str(value)) for value in values))
    return result


def _number(value: float | None) -> str | None:
    return None if value is None else f"{value:,.2f}"


SHOW_COMMAND = Command(
    "show",
    "show one trial: configuration, launches, attempts, loss",
    _run_show,
    _add_show_arguments,
)


_MIN_DIGITS = 4
_MAX_LISTED = 10
_TRIALS = "SELECT trial_id, trial_key, config_key, width, seed, status FROM v_trial"


@dataclass(frozen=True)
class ListedTrial:
    """One trial with its configuration."""

    trial_id: int
    trial_key: str
    seed: int
    status: str
    config: ConfigRow


def listed(
    reader: Reader, arguments: argparse.Namespace, **values: int | None
) -> list[ListedTrial]:
    """Return the trials of the chosen configurations, in the order of their registration.

    ``values`` of columns that are not None select a part of them.
    """
    configs = {config.config_key: config for config in chosen(reader, arguments)}
    given = {name: value for name, value in values.items() if value is not None}
    condition = " AND ".join(["1 = 1", *(f"{name} = :{name}" for name in given)])
    rows = reader.rows(f"{_TRIALS} WHERE {condition} ORDER BY trial_id", **given)
    return [
        ListedTrial(row.trial_id, row.trial_key, row.seed, row.status, configs[row.config_key])
        for row in rows
        if row.config_key in configs
    ]


def the_one(trials: Sequence[ListedTrial], start: str | None) -> ListedTrial:
    """Return the only trial, or the only one with a key that starts with ``start``.

    Raises ``UsageError`` unless exactly one fits.
    """
    if start is not None:
        _check(start)
        trials = [trial for trial in trials if trial.trial_key.startswith(start.lower())]
    if len(trials) == 1:
        return trials[0]
    named = f"a key that starts with {start}" if start else "these names"
    if not trials:
        raise UsageError(
            f"There is no trial with {named}: take a key from "
            f'query "SELECT trial_key, env, policy, seed, status FROM v_trial".'
        )
    some = "; ".join(map(describe, trials[:_MAX_LISTED]))
    rest = f" and {len(trials) - _MAX_LISTED:,} more" if len(trials) > _MAX_LISTED else ""
    raise UsageError(
        f"{len(trials):,} trials have {named}, one is expected: "
        f"give the key of one of {some}{rest}."
    )


def describe(trial: ListedTrial) -> str:
    """Return the first digits of the key, the environment, the label and the seed."""
    return f"{trial.trial_key[:12]} ({trial.config.env}, {trial.config.label}, seed {trial.seed})"


def _check(start: str) -> None:
    if not re.fullmatch(rf"[0-9a-fA-F]{{{_MIN_DIGITS},64}}", start):
        raise UsageError(
            f"'{start}' is no key of a trial, at least its first {_MIN_DIGITS} hexadecimal digits "
            f"are expected: give them, or --env, --policy and --seed."
        )


ROWS = (("env", "label"), ("env", "policy"), ("env",))
"""Columns that name a row of the grid, the longest table first."""

_STYLES = {
    "failed": "red",
    "diverged": "yellow",
    "cancelled": "red",
    "running": "cyan",
    "pending": "dim",
}


def grid_table(configs: Sequence[ConfigRow], max_rows: int) -> Table:
    """Return a table of at most ``max_rows`` rows, or of one for each environment.

    A row is a configuration by its label; where there are too many, all configurations of a policy
    or of an environment are counted together.
    """
    for columns in ROWS:
        rows: dict[tuple[str, ...], list[ConfigRow]] = {}
        for config in configs:
            rows.setdefault(tuple(getattr(config, name) for name in columns), []).append(config)
        if len(rows) <= max_rows:
            break
    merged = len(rows) < len(configs)
    total = counts(configs)
    states = [state for state in _STYLES if state != "cancelled" or total[state]]
    heads = [*columns, *(["configs"] if merged else []), "done", "of", *states]
    footers = ["total", *[""] * (len(columns) - 1), *_numbers(configs, states, merged)]
    styles = [_STYLES.get(head, "") for head in heads]
    result = table(heads, numbers={*heads} - {*columns}, styles=styles, footers=footers)
    for names, group in rows.items():
        result.add_row(*map(plain, names), *_numbers(group, states, merged))
    return result


def _numbers(configs: Sequence[ConfigRow], states: Sequence[str], merged: bool) -> list[str]:
    number = counts(configs)
    words = [f"{number['done']:,}", f"{number.total():,}"]
    words += [f"{number[state]:,}" if number[state] else "-" for state in states]
    return [f"{len(configs):,}", *words] if merged else words
