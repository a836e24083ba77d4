"""SQL page: read-only SELECT statements with limits, run by POST from its own form.

The process of a statement refuses what writes (see ``Reader.query``). On PostgreSQL the user
decides about functions such as ``pg_read_file``: it is the one of ``DOPT_READ_DB``, or, where only
this machine reaches the server, the one of the database.
"""

from __future__ import annotations

import csv
import io
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from analysis.serve.web import QueryParams, RequestError, ServerState
from orchestrate.store import READ_VARIABLE, QueryError, Table

MAX_ROWS = 1000
MAX_CSV_ROWS = 100_000
TIMEOUT_SECONDS = 10.0
MAX_CONCURRENT = 2

EXAMPLES = (
    ("Where the grid stands", "SELECT env, label, n_done, n_diverged, n_failed, n_pending\n"
     "FROM v_progress ORDER BY env, label"),
    ("Final losses", "SELECT env, label, count(*) AS n, avg(final_loss) AS mean,\n"
     "       min(final_loss) AS best, max(final_loss) AS worst\n"
     "FROM v_trial WHERE status = 'done'\nGROUP BY config_key, env, label ORDER BY env, mean"),
    ("A curve with its standard error", "SELECT label, t, mean, standard_error, n\n"
     "FROM v_curve_stats WHERE env = 'pendulum' AND policy = 'd_optimal'\nORDER BY config_key, t"),
    ("The ten worst trials", "SELECT env, label, seed, final_loss, trial_key\n"
     "FROM v_trial WHERE status = 'done' ORDER BY final_loss DESC LIMIT 10"),
    ("What failed, and why", "SELECT env, label, seed, cause, type, message\n"
     "FROM v_failures ORDER BY ended DESC"),
    ("Time and memory", "SELECT env, label, avg(wall_seconds) AS wall_s,\n"
     "       max(peak_memory_bytes) / 1048576 AS peak_mib\n"
     "FROM v_trial WHERE status = 'done'\nGROUP BY config_key, env, label ORDER BY wall_s DESC"),
    ("Control results", "SELECT env, label, t, count(*) AS n, avg(value) AS success_rate\n"
     "FROM v_assessment WHERE measure = 'control_success'\n"
     "GROUP BY config_key, env, label, t ORDER BY env, label, t"),
    ("Launches", "SELECT launch_id, state, started, ended, host, git_commit\n"
     "FROM launch ORDER BY launch_id DESC"),
)  # fmt: skip

VIEWS = {
    "v_trial": "one row per trial: configuration, status, losses, times, error",
    "v_curve": "one row per trial and step: loss and reachable loss",
    "v_curve_stats": "one row per configuration and step: mean loss and its standard error",
    "v_progress": "one row per configuration: number of trials by status",
    "v_failures": "one row per failed attempt: cause, error message and traceback",
    "v_assessment": "one row per assessed trial, number of explored steps t and measure: value",
}
"""Views of the database with a sentence on each."""

Stopped = Callable[[], bool]

_slots = threading.BoundedSemaphore(MAX_CONCURRENT)


def form(state: ServerState, params: QueryParams) -> dict[str, Any]:
    """Return what the form needs, with the statement ``q`` in it, which is not run."""
    return {
        "q": params.text("q"),
        "token": state.token,
        "access": _access(state),
        "examples": [{"title": title, "q": text} for title, text in EXAMPLES],
        "limits": {"rows": MAX_ROWS, "csv_rows": MAX_CSV_ROWS, "seconds": TIMEOUT_SECONDS},
        "views": _views(state),
        "error": None,
        "columns": None,
    }


def rows(state: ServerState, params: QueryParams, stopped: Stopped) -> dict[str, Any]:
    """Return the form with the rows or the error of its statement, if it holds one."""
    answer = form(state, params)
    if not answer["q"]:
        return answer
    start = time.monotonic()
    try:
        found = _run_query(state, params, MAX_ROWS, stopped)
    except QueryError as error:
        return answer | {"error": str(error)}
    return answer | {
        "columns": found.columns,
        "rows": [[_displayed(value) for value in row] for row in found],
        "cut": found.cut,
        "seconds": time.monotonic() - start,
    }


def _views(state: ServerState) -> list[dict[str, Any]]:
    """Return name, description and columns of every view."""
    reader = state.database.reader()

    def columns() -> list[list[str]]:
        return [list(reader.rows(f"SELECT * FROM {view} LIMIT 0").columns) for view in VIEWS]

    found = state.cache.get_or_compute(("views", reader), columns)
    return [
        {"name": name, "description": text, "columns": names}
        for (name, text), names in zip(VIEWS.items(), found, strict=True)
    ]


def table(state: ServerState, params: QueryParams, stopped: Stopped) -> str:
    """Return the rows as CSV; a last line says when the rows were cut."""
    found = _run_query(state, params, MAX_CSV_ROWS, stopped)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(found.columns)
    writer.writerows([_displayed(value) for value in row] for row in found)
    if found.cut:
        writer.writerow([f"# cut after {MAX_CSV_ROWS} rows"])
    return text.getvalue()


def _access(state: ServerState) -> tuple[bool, str]:
    """Return whether statements are run, and as whom or why not, in a sentence."""
    database = state.database
    if database.is_file:
        return True, ""
    if database.read_login:
        return True, f"Statements run as {database.read_login.username}, from {READ_VARIABLE}."
    lacks = f"{READ_VARIABLE} names no user of this database who can only read (docs/database.md)"
    if state.exposed:
        return (
            False,
            f"Other machines reach this server, and {lacks}: set it, or use --host 127.0.0.1.",
        )
    return True, (
        f"Statements run as {database.user or 'its owner'}, the user of the launches, because "
        f"{lacks}: functions such as pg_read_file and pg_terminate_backend have that user's rights."
    )


def _run_query(state: ServerState, params: QueryParams, rows: int, stopped: Stopped) -> Table:
    if not secrets.compare_digest(params.text("token").encode(), state.token.encode()):
        raise RequestError("The form is not one of this server: open the page SQL again.", 403)
    allowed, sentence = _access(state)
    if not allowed:
        raise RequestError(sentence, 403)
    with _slot(stopped):
        return state.database.reader().query(
            params.text("q"), rows, TIMEOUT_SECONDS, state.database.read_login, stopped
        )


@contextmanager
def _slot(stopped: Stopped) -> Iterator[None]:
    end = time.monotonic() + TIMEOUT_SECONDS
    while not _slots.acquire(timeout=0.1):
        if stopped() or time.monotonic() > end:
            raise RequestError(
                f"{MAX_CONCURRENT} queries are running: wait until one ends, then try again.", 429
            )
    try:
        yield
    finally:
        _slots.release()


def _displayed(value: object) -> object:
    """Return a value to display; for binary data its length."""
    return f"{len(value)} bytes" if isinstance(value, bytes | memoryview) else value
