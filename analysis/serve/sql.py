"""A SELECT that the user types, bounded in rows and time.

The database itself refuses everything that does not read its tables (see ``Reader.query``). On
PostgreSQL, functions such as ``pg_read_file`` are a matter of the role that the URL names.
"""

from __future__ import annotations

import csv
import io
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from analysis.serve.asked import Asked
from analysis.serve.errors import BusyError
from analysis.serve.site import Site
from orchestrate.store import Table
from orchestrate.store.errors import QueryError

ROWS = 1000
CSV_ROWS = 100_000
SECONDS = 10.0
AT_ONCE = 2

EXAMPLES = (
    ("Where the grid stands", "SELECT env, policy, width, n_done, n_diverged, n_failed, n_pending\n"
     "FROM v_progress ORDER BY env, policy, width"),
    ("Final losses", "SELECT env, policy, width, count(*) AS n, avg(final_loss) AS mean,\n"
     "       min(final_loss) AS best, max(final_loss) AS worst\n"
     "FROM v_trial WHERE status = 'done'\nGROUP BY env, policy, width ORDER BY env, mean"),
    ("A curve with its standard error", "SELECT t, mean, standard_error, n FROM v_curve_stats\n"
     "WHERE env = 'pendulum' AND policy = 'd_optimal' AND width = 16\nORDER BY t"),
    ("The ten worst trials", "SELECT env, policy, width, seed, final_loss, trial_key\n"
     "FROM v_trial WHERE status = 'done' ORDER BY final_loss DESC LIMIT 10"),
    ("What failed, and why", "SELECT env, policy, seed, cause, type, message\n"
     "FROM v_failures ORDER BY ended DESC"),
    ("Time and memory", "SELECT env, policy, width, avg(wall_seconds) AS wall_s,\n"
     "       max(peak_memory_bytes) / 1048576 AS peak_mib\n"
     "FROM v_trial WHERE status = 'done'\nGROUP BY env, policy, width ORDER BY wall_s DESC"),
    ("Launches", "SELECT launch_id, state, started, ended, host, git_commit\n"
     "FROM launch ORDER BY launch_id DESC"),
)  # fmt: skip

_places = threading.BoundedSemaphore(AT_ONCE)


def sql(site: Site, asked: Asked) -> dict[str, Any]:
    """Return the rows of the statement ``q``, its error, or nothing where none is given."""
    statement = asked.text("q")
    answer: dict[str, Any] = {
        "q": statement,
        "examples": [{"title": title, "q": text} for title, text in EXAMPLES],
        "limits": {"rows": ROWS, "csv_rows": CSV_ROWS, "seconds": SECONDS},
        "is_file": site.source.is_file,
        "error": None,
        "columns": None,
    }
    if not statement:
        return answer
    start = time.monotonic()
    try:
        found = _ask(site, statement, ROWS)
    except QueryError as error:
        return answer | {"error": str(error)}
    return answer | {
        "columns": found.columns,
        "rows": [[_shown(value) for value in row] for row in found],
        "cut": found.cut,
        "seconds": time.monotonic() - start,
    }


def table(site: Site, asked: Asked) -> str:
    """Return the rows as CSV, with a last line that says so where rows are cut."""
    found = _ask(site, asked.text("q"), CSV_ROWS)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(found.columns)
    writer.writerows([_shown(value) for value in row] for row in found)
    if found.cut:
        writer.writerow([f"# cut after {CSV_ROWS} rows"])
    return text.getvalue()


def _ask(site: Site, statement: str, rows: int) -> Table:
    with _place():
        return site.source.reader().query(statement, limit=rows, timeout=SECONDS)


@contextmanager
def _place() -> Iterator[None]:
    if not _places.acquire(timeout=SECONDS):
        raise BusyError(f"{AT_ONCE} queries run already: wait for them to end, then try again.")
    try:
        yield
    finally:
        _places.release()


def _shown(value: object) -> object:
    """Return a value for people: of bytes their number alone."""
    return f"{len(value)} bytes" if isinstance(value, bytes | memoryview) else value
