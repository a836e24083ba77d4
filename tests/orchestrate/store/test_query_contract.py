"""A query that anybody may type: it reads the tables and nothing else, and it ends."""

from __future__ import annotations

import datetime
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from decimal import Decimal
from pathlib import Path

import pytest

from orchestrate.errors import ExitCode
from orchestrate.store import Claim, QueryError, Reader, Store, StoreUnavailableError
from orchestrate.store import reader as user_query
from tests.orchestrate.faults.laboratory import PATIENCE_SECONDS, alive, children, until
from tests.orchestrate.store.fakes import HORIZON, RUN, Spec, result

ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT count(*) FROM n"
SERIES = "WITH RECURSIVE s(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM s WHERE n < {}) "
ONE_CALL = "SELECT instr(hex(zeroblob(30000000)), hex(zeroblob(15000000)) || '1')"
"""One call of a function of SQLite, which takes hours and never looks at a limit."""

ESCAPES = (
    "DELETE FROM step",
    "COMMIT; DELETE FROM step",
    "COMMIT; BEGIN; DELETE FROM step; COMMIT",
    "SELECT 1; DELETE FROM step",
    "WITH gone AS (DELETE FROM step RETURNING t) SELECT * FROM gone",
    "INSERT INTO step (trial_id, t) VALUES (1, 999) RETURNING t",
    "CREATE TEMP TABLE trial AS SELECT 1 AS x",
    "COMMIT",
    "ROLLBACK",
    "DROP VIEW v_trial",
    "COMMIT; DROP VIEW v_trial",
    "COMMIT; CREATE TABLE more (x INTEGER)",
    "UPDATE trial SET seed = 1",
    "INSERT INTO trial SELECT * FROM trial",
    "DROP TABLE step",
    "BEGIN",
    "VACUUM",
)
SQLITE_ESCAPES = (
    "ATTACH DATABASE '{other}' AS other",
    "VACUUM INTO '{other}'",
    "SELECT load_extension('{other}')",
    "SELECT readfile('{other}')",
    "SELECT writefile('{other}', 'x')",
    "PRAGMA query_only = 0",
    "PRAGMA cache_size = -1000000",
    "PRAGMA journal_mode = DELETE",
    "UPDATE sqlite_master SET sql = ''",
    "PRAGMA writable_schema = 1",
    "PRAGMA temp_store_directory = '/tmp'",
    "SELECT edit('x')",
)
POSTGRESQL_ESCAPES = (
    "SET default_transaction_read_only = off; COMMIT; DELETE FROM step",
    "COMMIT; BEGIN READ WRITE; DELETE FROM step; COMMIT",
    "SET TRANSACTION READ WRITE",
    "DO $$ BEGIN DELETE FROM step; END $$",
    "COPY step TO PROGRAM 'cat'",
    "COPY (SELECT 1) TO STDOUT",
    "SELECT nextval('launch_launch_id_seq')",
    "SELECT * FROM step FOR UPDATE",
    "COPY trial FROM '/etc/passwd'",
    "SET default_transaction_read_only = off",
    "SET SESSION CHARACTERISTICS AS TRANSACTION READ WRITE",
    "SELECT set_config('transaction_read_only', 'off', true)",
    "LISTEN x",
)


@pytest.fixture
def two_trials(store: Store, take: Callable[..., list[Claim]]) -> None:
    for claim in take(Spec(0), Spec(1)):
        store.commit(claim, result(), RUN)


@pytest.fixture
def file(sqlite_url: str) -> Iterator[Reader]:
    Store.open(sqlite_url).close()
    with Reader.open(sqlite_url) as opened:
        yield opened


@pytest.fixture
def on_server(postgresql_url: str) -> Iterator[Reader]:
    Store.open(postgresql_url).close()
    with Reader.open(postgresql_url) as opened:
        yield opened


def rows_left(reader: Reader) -> int:
    return len(reader.query("SELECT * FROM step"))


@pytest.mark.usefixtures("two_trials")
def test_it_cannot_write(reader: Reader) -> None:
    for escape in ESCAPES:
        with pytest.raises(QueryError):
            reader.query(escape)
        assert len(reader.rows("SELECT * FROM step")) == 2 * HORIZON, escape
    assert rows_left(reader) == 2 * HORIZON
    assert reader.query("SELECT * FROM v_trial")


def test_it_cannot_leave_the_file(file: Reader, tmp_path: Path) -> None:
    other = tmp_path / "other.db"
    other.write_text("not for you")
    for escape in SQLITE_ESCAPES:
        with pytest.raises(QueryError):
            file.query(escape.format(other=other))
        assert other.read_text() == "not for you", escape
    assert file.query("SELECT * FROM trial") == []


def test_it_cannot_change_the_session(on_server: Reader) -> None:
    for escape in POSTGRESQL_ESCAPES:
        with pytest.raises(QueryError):
            on_server.query(escape)
    assert on_server.query("SELECT * FROM trial") == []


def test_a_setting_does_not_outlive_its_query(on_server: Reader) -> None:
    on_server.query("SELECT set_config('default_transaction_read_only', 'off', false)")
    ((value,),) = on_server.query("SELECT current_setting('default_transaction_read_only')")
    assert value == "on"


def test_functions_that_return_tables_answer(file: Reader) -> None:
    assert len(file.query("SELECT value FROM json_each('[1, 2]')")) == 2
    assert file.query("SELECT name FROM pragma_table_info('trial')")
    assert file.query("EXPLAIN QUERY PLAN SELECT * FROM v_curve")


@pytest.mark.usefixtures("two_trials")
def test_it_says_when_rows_are_cut(reader: Reader) -> None:
    whole = reader.query("SELECT t FROM step ORDER BY t", limit=2 * HORIZON)
    assert (len(whole), whole.cut) == (2 * HORIZON, False)
    part = reader.query("SELECT t FROM step ORDER BY t", limit=3)
    assert (len(part), part.cut) == (3, True)
    assert [row.t for row in part] == [0, 0, 1]


@pytest.mark.usefixtures("two_trials")
def test_a_limit_keeps_the_names_of_no_rows(reader: Reader) -> None:
    assert reader.query("SELECT t FROM step WHERE t < 0", limit=5).columns == ("t",)


@pytest.mark.usefixtures("two_trials")
def test_it_is_ended_after_its_time(reader: Reader) -> None:
    with pytest.raises(QueryError, match=r"longer than 0\.2 s and was cancelled: .* --timeout\.$"):
        reader.query(ENDLESS, timeout=0.2)
    assert rows_left(reader) == 2 * HORIZON
    assert len(reader.query("SELECT t FROM step", timeout=60)) == 2 * HORIZON


def test_nothing_is_no_query(reader: Reader) -> None:
    with pytest.raises(QueryError):
        reader.query("-- nothing")


def test_a_lost_server_is_not_the_fault_of_the_query(on_server: Reader) -> None:
    with pytest.raises(StoreUnavailableError) as caught:
        on_server.query("SELECT pg_terminate_backend(pg_backend_pid())")
    assert caught.value.transient


def test_one_call_is_ended_after_its_time(file: Reader) -> None:
    with pytest.raises(QueryError, match=r"longer than 0\.2 s and was cancelled"):
        file.query(ONE_CALL, timeout=0.2)


@pytest.mark.parametrize(
    "statement",
    [
        "SELECT zeroblob(67000000)",
        SERIES.format(1000) + "SELECT zeroblob(67000000) FROM s",
        SERIES.format(1000) + "SELECT hex(zeroblob(100000)) FROM s",
    ],
)
def test_a_result_has_a_limit(file: Reader, statement: str) -> None:
    with pytest.raises(QueryError, match="larger than 50 MB"):
        file.query(statement, limit=1000)


def test_a_result_of_a_server_has_a_limit(on_server: Reader) -> None:
    with pytest.raises(QueryError, match="larger than 50 MB"):
        on_server.query("SELECT repeat('x', 60000000) FROM generate_series(1, 1000)", limit=1000)


@pytest.mark.parametrize(
    "statement",
    [
        f"SELECT {', '.join(['zeroblob(60000000)'] * 20)}",
        # A sort, which would fill the disk with a temporary file.
        f"SELECT count(*) FROM ({SERIES.format(100)} SELECT zeroblob(60000000) AS b FROM s"
        " ORDER BY n % 7)",
    ],
    ids=["row", "sort"],
)
def test_memory_has_a_limit(file: Reader, statement: str) -> None:
    with pytest.raises(QueryError, match="needs more than 1 GiB of memory"):
        file.query(statement)


def test_a_text_that_no_database_takes_is_one_sentence(reader: Reader) -> None:
    with pytest.raises(QueryError, match="The query failed on"):
        reader.query("SELECT '\ud800'")


def test_values_keep_their_types(file: Reader, on_server: Reader) -> None:
    (row,) = file.query("SELECT NULL, 1, 2.5, 'ä', x'00ff', 9e999, -9223372036854775808")
    assert tuple(row) == (None, 1, 2.5, "ä", b"\0\xff", float("inf"), -(2**63))
    (row,) = on_server.query(
        "SELECT NULL, 1, 2.5::float8, 2.50::numeric, 'ä', '\\x00ff'::bytea, true, "
        "DATE '2024-02-29', ARRAY[1, 2], '{\"a\": 1}'::json, interval '1 day', 7 % 4"
    )
    assert tuple(row[:8]) == (
        *(None, 1, 2.5, Decimal("2.50"), "ä", b"\0\xff", True, datetime.date(2024, 2, 29)),
    )
    assert tuple(row[8:]) == ([1, 2], {"a": 1}, datetime.timedelta(days=1), 3)


@contextmanager
def asked(url: str, statement: str) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """Run the command ``query`` with an endless statement; yield it and the query's process."""
    words = ["query", statement, "--db", url, "--timeout", "3600"]
    command = subprocess.Popen(
        [sys.executable, "-m", "orchestrate", *words], start_new_session=True
    )
    try:
        until(lambda: bool(children(command.pid)))
        yield command, children(command.pid)[0]
    finally:
        command.kill()
        command.wait()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_query_outlives_its_command(sqlite_url: str, number: signal.Signals) -> None:
    Store.open(sqlite_url).close()
    with asked(sqlite_url, ONE_CALL) as (command, query):
        if number == signal.SIGINT:
            os.killpg(command.pid, number)  # as a terminal does
            assert command.wait(PATIENCE_SECONDS) == ExitCode.INTERRUPTED
        else:
            command.send_signal(number)
        until(lambda: not alive(query))


def test_a_query_that_was_killed_is_one_sentence(
    file: Reader, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(user_query, "_COMMAND", (sys.executable, "-c", ""))
    with pytest.raises(QueryError, match="was killed before its end"):
        file.query("SELECT 1" + " " * 10**6)


def test_it_ends_when_nobody_waits_for_it(reader: Reader) -> None:
    with pytest.raises(QueryError, match="nobody waits for it"):
        reader.query(ENDLESS, stopped=lambda: True)


def test_a_statement_cannot_lift_its_limit(on_server: Reader) -> None:
    with pytest.raises(QueryError, match=r"longer than 0\.5 s"):
        on_server.query(
            "SELECT set_config('statement_timeout', '0', false) "
            "UNION ALL SELECT pg_sleep(3600)::text",
            timeout=0.5,
        )
    running = "SELECT 1 FROM pg_stat_activity WHERE query LIKE 'FETCH%query%' AND state = 'active'"
    until(lambda: not on_server.rows(running))


def test_what_a_statement_made_is_rolled_back(on_server: Reader) -> None:
    with suppress(QueryError):  # from PostgreSQL 16 on
        on_server.query("SELECT lo_create(0)")
    assert on_server.rows("SELECT * FROM pg_largeobject_metadata") == []


def test_a_smaller_limit_of_the_shell_stays(sqlite_url: str) -> None:
    Store.open(sqlite_url).close()
    words = f"{sys.executable} -m orchestrate query 'SELECT 41 + 1' --csv --db {sqlite_url}"
    limited = ["sh", "-c", f"ulimit -f 100000; {words}"]
    done = subprocess.run(limited, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[1:] == ["42"], done.stderr


def test_its_process_imports_the_driver_alone(
    file: Reader, on_server: Reader, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    listing = tmp_path / "imports"
    python, *words = user_query._COMMAND
    traced = ("sh", "-c", f'exec "$0" "$@" 2>>{listing}', python, "-X", "importtime", *words)
    monkeypatch.setattr(user_query, "_COMMAND", traced)
    monkeypatch.setattr(user_query.subprocess, "DEVNULL", None)
    for reader in (file, on_server):
        assert reader.query("SELECT 1 AS one")[0].one == 1
    found = {line.rpartition("|")[2].strip() for line in listing.read_text().splitlines()}
    assert {"sqlite3", "psycopg"} <= found
    packages = {name.partition(".")[0] for name in found}
    assert packages.isdisjoint({"sqlalchemy", "numpy", "dopt", "orchestrate", "analysis", "site"})
