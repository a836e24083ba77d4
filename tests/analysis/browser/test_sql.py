"""The SQL page reads, and does nothing else, within its time and rows, on both databases."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from analysis.serve import sql
from orchestrate.store.schema import VIEWS
from tests.analysis.browser.forms import post

Visit = Callable[..., TestClient]

SERIES = "WITH RECURSIVE s(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM s WHERE n < {}) "
WRITES = (
    "DELETE FROM step",
    "UPDATE trial SET seed = 1",
    "INSERT INTO trial SELECT * FROM trial",
    "DROP TABLE step",
    "CREATE TABLE mine (number INTEGER)",
    "CREATE TEMP TABLE mine AS SELECT 1",
    "SELECT 1; DELETE FROM step",
    "COMMIT",
    "COMMIT; DELETE FROM step",
    "BEGIN",
    "VACUUM",
)
SQLITE_ONLY = (
    "ATTACH DATABASE '/tmp/other.db' AS other",
    "PRAGMA journal_mode = DELETE",
    "PRAGMA writable_schema = 1",
    "PRAGMA temp_store_directory = '/tmp'",
    "SELECT load_extension('/tmp/evil')",
    "SELECT readfile('/etc/passwd')",
    "SELECT writefile('/tmp/evil', 'x')",
    "SELECT edit('x')",
    "VACUUM INTO '/tmp/copy.db'",
)
POSTGRESQL_ONLY = (
    "COPY trial TO '/tmp/evil'",
    "COPY trial FROM '/etc/passwd'",
    "COPY (SELECT 1) TO PROGRAM 'id'",
    "SET default_transaction_read_only = off",
    "SET SESSION CHARACTERISTICS AS TRANSACTION READ WRITE",
    "WITH gone AS (DELETE FROM step RETURNING t) SELECT * FROM gone",
    "SELECT set_config('transaction_read_only', 'off', true)",
    "LISTEN x",
    "DO $$ BEGIN DELETE FROM step; END $$",
)


def ask(client: TestClient, statement: str) -> tuple[int, dict[str, object]]:
    answer = post(client, "/api/sql", statement)
    return answer.status_code, answer.json()


def test_every_example_answers(client: TestClient) -> None:
    for _, statement in sql.EXAMPLES:
        status, found = ask(client, statement)
        assert status == 200, found
        assert found["columns"]
        assert post(client, "/sql", statement).status_code == 200
        assert post(client, "/api/sql.csv", statement).status_code == 200


def test_the_page_names_every_view_with_its_columns(client: TestClient) -> None:
    assert set(sql.VIEWS) == set(VIEWS)
    _, found = ask(client, "")
    for view in found["views"]:  # type: ignore[attr-defined]
        _, answer = ask(client, f"SELECT * FROM {view['name']}")
        assert answer["columns"] == view["columns"]
    page = client.get("/sql").text
    assert "v_assessment" in page
    assert "status, t, measure, value" in page


def test_an_answer_has_columns_rows_and_bytes_in_words(client: TestClient) -> None:
    _, found = ask(client, "SELECT env, policy, seed % 2 AS odd FROM v_trial WHERE width = 4")
    assert found["columns"] == ["env", "policy", "odd"]
    assert len(found["rows"]) == 8  # type: ignore[arg-type]
    _, found = ask(client, "SELECT states FROM trajectory LIMIT 1")
    assert found["rows"] == [["656 bytes"]]
    text = post(client, "/api/sql.csv", "SELECT 1 AS one, NULL AS none, 'a,b' AS c")
    assert text.text == 'one,none,c\n1,,"a,b"\n'
    assert "attachment" in text.headers["content-disposition"]


def test_rows_are_cut_and_the_page_says_so(client: TestClient) -> None:
    statement = SERIES.format(2500) + "SELECT n FROM s"
    _, found = ask(client, statement)
    assert found["cut"] is True
    assert len(found["rows"]) == sql.MAX_ROWS  # type: ignore[arg-type]
    assert "Only the first 1,000 rows" in post(client, "/sql", statement).text
    assert len(post(client, "/api/sql.csv", statement).text.splitlines()) == 2501


def test_a_slow_query_is_ended(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(sql, "TIMEOUT_SECONDS", 0.5)
        status, found = ask(client, SERIES.format(10**12) + "SELECT count(*) FROM s")
    assert status == 400
    assert "longer than 0.5 s" in str(found["error"])
    assert ask(client, "SELECT 1 AS one")[0] == 200


@pytest.mark.parametrize("statement", [*WRITES, *SQLITE_ONLY, *POSTGRESQL_ONLY])
def test_whatever_does_not_only_read_is_refused(client: TestClient, statement: str) -> None:
    before = client.get("/api/grid").json()["progress"]
    status, found = ask(client, statement)
    assert status == 400, found
    assert found["error"]
    page = post(client, "/sql", statement)
    assert page.status_code == 400
    assert 'role="alert"' in page.text
    assert client.get("/api/grid").json()["progress"] == before
    assert ask(client, "SELECT count(*) FROM step")[1]["rows"] == [[44 * 40]]
    assert not Path("/tmp/evil").exists()


def test_no_answer_changes_what_is_asked_next(client: TestClient) -> None:
    ask(client, "SELECT set_config('default_transaction_read_only', 'off', false)")
    status, _ = ask(client, "CREATE TABLE mine (number INTEGER)")
    assert status == 400


def test_a_value_cannot_fill_the_memory(visit: Visit, sqlite_grid: str) -> None:
    client = visit(sqlite_grid)
    for statement in ("SELECT zeroblob(1000000000)", "SELECT printf('%900000000d', 1)"):
        status, found = ask(client, statement)
        assert status == 400 or found["rows"] == [[None]]
    assert ask(client, "SELECT length(zeroblob(1000000)) AS n")[1]["rows"] == [[1000000]]


def test_too_many_at_once_wait_or_are_told(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(sql.MAX_CONCURRENT):
        assert sql._slots.acquire(blocking=False)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(sql, "TIMEOUT_SECONDS", 0.05)
            assert post(client, "/api/sql", "SELECT 1").status_code == 429
    finally:
        for _ in range(sql.MAX_CONCURRENT):
            sql._slots.release()
    assert post(client, "/api/sql", "SELECT 1 AS one").status_code == 200


def test_the_role_is_mentioned_where_it_decides(
    visit: Visit, sqlite_grid: str, postgresql_grid: str
) -> None:
    assert "pg_read_file" in visit(postgresql_grid).get("/sql").text
    assert "pg_read_file" not in visit(sqlite_grid).get("/sql").text
