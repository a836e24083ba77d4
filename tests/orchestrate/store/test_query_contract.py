"""A query that anybody may type: it reads the tables and nothing else, and it ends."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from orchestrate.store import Claim, QueryError, Reader, Store, StoreUnavailableError
from tests.orchestrate.store.fakes import HORIZON, RUN, Spec, result

ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT count(*) FROM n"
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
)


@pytest.fixture
def two_trials(store: Store, take: Callable[..., list[Claim]]) -> None:
    for claim in take(Spec(0), Spec(1)):
        store.commit(claim, result(), RUN)


def rows_left(reader: Reader) -> int:
    return len(reader.query("SELECT * FROM step"))


@pytest.mark.usefixtures("two_trials")
@pytest.mark.parametrize("escape", ESCAPES)
def test_it_cannot_write(reader: Reader, escape: str) -> None:
    with pytest.raises(QueryError):
        reader.query(escape)
    assert rows_left(reader) == 2 * HORIZON


@pytest.mark.parametrize("escape", SQLITE_ESCAPES)
def test_it_cannot_leave_the_file(sqlite_url: str, tmp_path: Path, escape: str) -> None:
    other = tmp_path / "other.db"
    other.write_text("not for you")
    Store.open(sqlite_url).close()
    with Reader.open(sqlite_url) as reader:
        with pytest.raises(QueryError):
            reader.query(escape.format(other=other))
        assert reader.query("SELECT * FROM trial") == []
    assert other.read_text() == "not for you"


@pytest.mark.parametrize("escape", POSTGRESQL_ESCAPES)
def test_it_cannot_change_the_session(postgresql_url: str, escape: str) -> None:
    Store.open(postgresql_url).close()
    with Reader.open(postgresql_url) as reader:
        with pytest.raises(QueryError):
            reader.query(escape)
        assert reader.query("SELECT * FROM trial") == []


def test_a_setting_does_not_outlive_its_query(postgresql_url: str) -> None:
    Store.open(postgresql_url).close()
    with Reader.open(postgresql_url) as reader:
        reader.query("SELECT set_config('default_transaction_read_only', 'off', false)")
        ((value,),) = reader.query("SELECT current_setting('default_transaction_read_only')")
        assert value == "on"


def test_functions_that_return_tables_answer(sqlite_url: str) -> None:
    Store.open(sqlite_url).close()
    with Reader.open(sqlite_url) as reader:
        assert len(reader.query("SELECT value FROM json_each('[1, 2]')")) == 2
        assert reader.query("SELECT name FROM pragma_table_info('trial')")
        assert reader.query("EXPLAIN QUERY PLAN SELECT * FROM v_curve")


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
    with pytest.raises(QueryError, match=r"longer than 0\.2 s and was cancelled"):
        reader.query(ENDLESS, timeout=0.2)
    assert rows_left(reader) == 2 * HORIZON
    assert len(reader.query("SELECT t FROM step", timeout=60)) == 2 * HORIZON


def test_nothing_is_no_query(reader: Reader) -> None:
    with pytest.raises(QueryError):
        reader.query("-- nothing")


def test_a_lost_server_is_not_the_fault_of_the_query(postgresql_url: str) -> None:
    Store.open(postgresql_url).close()
    with Reader.open(postgresql_url) as reader, pytest.raises(StoreUnavailableError) as caught:
        reader.query("SELECT pg_terminate_backend(pg_backend_pid())")
    assert caught.value.transient
