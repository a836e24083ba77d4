"""Who may run statements, as whom, and what they cannot do to a launch on PostgreSQL."""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable, Iterator

import pytest
from sqlalchemy import Engine, make_url, text
from starlette.testclient import TestClient

from analysis.serve import sql
from analysis.serve.app import create_app
from analysis.serve.web import Database, ServerState
from orchestrate.store import Store
from tests.analysis.browser import grids
from tests.analysis.browser.conftest import BASE
from tests.analysis.browser.forms import post
from tests.analysis.synthetic import make_grid

Visit = Callable[..., TestClient]
RUN = "SELECT 41 + 1 AS answer"


@pytest.fixture
def server_grid(postgresql_url: str) -> str:
    Store.open(postgresql_url).close()
    return postgresql_url


@pytest.fixture
def login(server: Engine, server_grid: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Name a user that can only read in the environment, and return its name."""
    name, schema = f"read_{uuid.uuid4().hex}", server_grid.rpartition("%3D")[2]
    with server.begin() as connection:
        connection.execute(text(f"CREATE ROLE {name} LOGIN PASSWORD 'secret'"))
        connection.execute(text(f"GRANT USAGE ON SCHEMA {schema} TO {name}"))
        connection.execute(text(f"GRANT SELECT ON ALL TABLES IN SCHEMA {schema} TO {name}"))
    url = make_url(server_grid).set(username=name, password="secret", query={})
    monkeypatch.setenv("DOPT_READ_DB", url.render_as_string(hide_password=False))
    yield name
    with server.begin() as connection:
        connection.execute(text(f"DROP OWNED BY {name}"))
        connection.execute(text(f"DROP ROLE {name}"))


def launch(url: str) -> None:
    """Register a trial and give it an outcome, as a launch does."""
    (spec,) = make_grid(("pendulum",), ("random",), range(1), **grids.SHORT)
    with Store.open(url) as store:
        number = grids.begin(store)
        store.register(number, [spec])
        grids.finish(store, number, spec)


def test_statements_run_as_the_user_who_can_only_read(
    visit: Visit, server_grid: str, login: str
) -> None:
    client = visit(server_grid)
    page = post(client, "/sql", "SELECT current_user AS name, count(*) FROM v_trial").text
    assert f"Statements run as {login}, from DOPT_READ_DB" in page
    assert page.count(login) == 2
    assert "secret" not in page


@pytest.mark.parametrize(
    "statement",
    [
        "SELECT pg_advisory_lock(hashtext('dopt.store.' || current_schema()))",
        "SELECT pg_advisory_lock_shared(hashtext('dopt.store.' || current_schema()))",
        "SELECT pg_terminate_backend({pid})",
        "SELECT pg_cancel_backend({pid})",
        "SELECT pg_sleep(3600)",
        "SELECT set_config('role', '{owner}', false)",
        "SELECT set_config('role', '{owner}', true), pg_terminate_backend({pid})",
        "SELECT set_config('default_transaction_read_only', 'off', false)",
        "SELECT * FROM trial FOR UPDATE",
        "LOCK TABLE trial",
    ],
)
@pytest.mark.usefixtures("login")
def test_no_statement_harms_a_launch(
    visit: Visit,
    server: Engine,
    server_grid: str,
    monkeypatch: pytest.MonkeyPatch,
    statement: str,
) -> None:
    client, works = visit(server_grid), re.search("advisory|read_only", statement)
    with server.connect() as other, monkeypatch.context() as patch:
        patch.setattr(sql, "TIMEOUT_SECONDS", sql.TIMEOUT_SECONDS if works else 1.0)
        pid, owner = other.execute(text("SELECT pg_backend_pid(), current_user")).one()
        answer = post(client, "/api/sql", statement.format(pid=pid, owner=owner))
        assert answer.status_code == (200 if works else 400)
        assert other.execute(text("SELECT 1")).scalar_one() == 1
    launch(server_grid)
    found = post(client, "/api/sql", "SELECT current_user, count(*) FROM v_trial").json()
    assert found["rows"][0][0] != owner
    assert found["rows"][0][1] == 1


@pytest.mark.usefixtures("login")
def test_a_login_of_another_database_is_not_one_of_this(
    visit: Visit, sqlite_grid: str, server_grid: str
) -> None:
    other = make_url(server_grid).set(database="another").render_as_string(hide_password=False)
    assert "pg_terminate_backend" in sql._access(ServerState(Database(other)))[1]
    assert post(visit(sqlite_grid), "/api/sql", RUN).json()["rows"] == [[42]]


def test_the_owner_is_named_and_holds_no_lock_after_a_statement(
    visit: Visit, server: Engine, server_grid: str
) -> None:
    client = visit(server_grid)
    assert "user of the launches" in client.get("/sql").text
    number = uuid.uuid4().int % 2**31
    assert post(client, "/api/sql", f"SELECT pg_advisory_lock({number})").status_code == 200
    held = text(f"SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND objid = {number}")
    with server.connect() as connection:
        assert connection.execute(held).scalar_one() == 0
    launch(server_grid)


def test_the_owner_asks_from_this_machine_alone(server_grid: str, sqlite_grid: str) -> None:
    for url, status in ((server_grid, 403), (sqlite_grid, 200)):
        with TestClient(create_app(url, "0.0.0.0"), base_url=BASE) as client:
            assert client.get("/sql").status_code == 200
            answer = post(client, "/api/sql", RUN)
            assert answer.status_code == status
            if status == 403:
                assert "DOPT_READ_DB names no user" in answer.json()["error"]
                assert "DOPT_READ_DB names no user" in client.get("/sql").text


@pytest.mark.usefixtures("login")
def test_other_machines_ask_as_the_user_who_can_only_read(server_grid: str) -> None:
    with TestClient(create_app(server_grid, "0.0.0.0"), base_url=BASE) as client:
        assert post(client, "/api/sql", RUN).json()["rows"] == [[42]]


def test_a_link_runs_nothing(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sql, "_run_query", lambda *_: pytest.fail("a link ran a statement"))
    cross = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    for headers in ({}, cross):
        page = client.get("/sql", params={"q": RUN}, headers=headers)
        assert page.status_code == 200
        assert f">{RUN}</textarea>" in page.text
        assert 'id="answer"' not in page.text
    for path in ("/api/sql", "/api/sql.csv"):
        answer = client.get(path, params={"q": RUN})
        assert (answer.status_code, answer.headers["allow"]) == (405, "POST")


@pytest.mark.parametrize(
    "headers",
    [
        {"sec_fetch_site": "cross-site"},
        {"sec_fetch_site": "same-site"},
        {"origin": "http://evil.example"},
        {"origin": "http://127.0.0.1:8001"},
        {"origin": "http://evil.example", "sec_fetch_site": "same-origin"},
        {"origin": "null", "sec_fetch_site": "cross-site"},
        {"origin": "http://evil127.0.0.1:8000"},
    ],
)
def test_a_form_of_another_site_is_refused(client: TestClient, headers: dict[str, str]) -> None:
    for path in ("/sql", "/api/sql", "/api/sql.csv"):
        answer = post(client, path, RUN, **headers)
        assert answer.status_code == 403
        assert "42" not in answer.text


def test_a_form_of_this_server_is_answered(client: TestClient) -> None:
    for headers in (
        {"origin": BASE, "sec_fetch_site": "same-origin"},
        {"origin": "null", "sec_fetch_site": "same-origin"},
        {"origin": "null"},
    ):
        assert post(client, "/api/sql", RUN, **headers).json()["rows"] == [[42]]


def test_a_form_needs_the_token_of_this_process(client: TestClient, visit: Visit) -> None:
    other = visit("sqlite:///nothing.db")
    assert other is not client
    for token in ("", "x", "é", "A" * 43):
        answer = client.post("/api/sql", data={"q": RUN, "token": token})
        assert answer.status_code == 403
        assert "not one of this server" in answer.json()["error"]


def test_a_form_has_bounds(client: TestClient) -> None:
    assert post(client, "/api/sql", "x" * 20_000).status_code == 400
    assert client.post("/api/sql", content=b"q=1&\xff\xfe%zz=&&;").status_code == 403
