"""Statements of the SQL page, their login, and who may ask for which file."""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable, Iterator
from urllib.parse import quote, urlencode

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import Engine, make_url, text
from starlette.testclient import TestClient

from analysis.serve import sql
from analysis.serve.app import create_app, is_own
from analysis.serve.web import Database, ServerState
from orchestrate.store import Store
from orchestrate.store.schema import VIEWS
from tests.analysis.browser import grids
from tests.analysis.browser.conftest import BASE
from tests.analysis.browser.grids import post
from tests.analysis.synthetic import make_grid
from tests.waiting import until

Visit = Callable[..., TestClient]

SERIES = "WITH RECURSIVE s(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM s WHERE n < {}) "


def ask(client: TestClient, statement: str) -> tuple[int, dict[str, object]]:
    answer = post(client, "/api/sql", statement)
    return answer.status_code, answer.json()


@pytest.fixture
def guarded(sqlite_grid: str, visit: Visit) -> TestClient:
    """Return a client over one kind of database, for what does not depend on it."""
    return visit(sqlite_grid)


def test_every_example_answers(client: TestClient) -> None:
    for _, statement in sql.EXAMPLES:
        status, found = ask(client, statement)
        assert status == 200, found
        assert found["columns"]
        assert "avg(" not in statement or "GROUP BY config_key" in statement
    assert post(client, "/sql", sql.EXAMPLES[0][1]).status_code == 200
    assert post(client, "/api/sql.csv", sql.EXAMPLES[0][1]).status_code == 200


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


def test_whatever_does_not_only_read_is_refused(client: TestClient) -> None:
    """More statements are in ``tests/orchestrate/store/test_query_contract.py``."""
    before = client.get("/api/grid").json()["progress"]
    for statement in ("DELETE FROM step", "SELECT 1; DELETE FROM step", "COMMIT"):
        status, found = ask(client, statement)
        assert status == 400, (statement, found)
        assert found["error"]
    assert client.get("/api/grid").json()["progress"] == before
    page = post(client, "/sql", "DELETE FROM step")
    assert page.status_code == 400
    assert 'role="alert"' in page.text


def test_too_many_at_once_wait_or_are_told(
    guarded: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(sql.MAX_CONCURRENT):
        assert sql._slots.acquire(blocking=False)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(sql, "TIMEOUT_SECONDS", 0.05)
            assert post(guarded, "/api/sql", "SELECT 1").status_code == 429
    finally:
        for _ in range(sql.MAX_CONCURRENT):
            sql._slots.release()
    assert post(guarded, "/api/sql", "SELECT 1 AS one").status_code == 200


def test_the_role_is_mentioned_where_it_decides(
    visit: Visit, sqlite_grid: str, postgresql_grid: str
) -> None:
    assert "pg_read_file" in visit(postgresql_grid).get("/sql").text
    assert "pg_read_file" not in visit(sqlite_grid).get("/sql").text


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


def launch(url: str, seed: int = 0) -> None:
    """Register a trial and give it an outcome, as a launch does."""
    (spec,) = make_grid(("pendulum",), ("random",), [seed], **grids.SHORT)
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


HARMS = (
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
)


@pytest.mark.usefixtures("login")
def test_no_statement_harms_a_launch(
    visit: Visit, server: Engine, server_grid: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, usual = visit(server_grid), sql.TIMEOUT_SECONDS
    for seed, statement in enumerate(HARMS):
        works = re.search("advisory|read_only", statement)
        with server.connect() as other, monkeypatch.context() as patch:
            patch.setattr(sql, "TIMEOUT_SECONDS", usual if works else 1.0)
            pid, owner = other.execute(text("SELECT pg_backend_pid(), current_user")).one()
            answer = post(client, "/api/sql", statement.format(pid=pid, owner=owner))
            assert answer.status_code == (200 if works else 400), statement
            assert other.execute(text("SELECT 1")).scalar_one() == 1, statement
        launch(server_grid, seed)
        found = post(client, "/api/sql", "SELECT current_user, count(*) FROM v_trial").json()
        assert found["rows"][0][0] != owner, statement
        assert found["rows"][0][1] == seed + 1, statement


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
        # The server ends a session a moment after its client has gone.
        until(lambda: connection.execute(held).scalar_one() == 0)
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


def test_a_link_runs_nothing(guarded: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sql, "_run_query", lambda *_: pytest.fail("a link ran a statement"))
    cross = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    for headers in ({}, cross):
        page = guarded.get("/sql", params={"q": RUN}, headers=headers)
        assert page.status_code == 200
        assert f">{RUN}</textarea>" in page.text
        assert 'id="answer"' not in page.text
    for path in ("/api/sql", "/api/sql.csv"):
        answer = guarded.get(path, params={"q": RUN})
        assert (answer.status_code, answer.headers["allow"]) == (405, "POST")


@pytest.mark.parametrize(
    ("origin", "site", "own"),
    [
        (None, "cross-site", False),
        (None, "same-site", False),
        ("http://evil.example", None, False),
        ("http://127.0.0.1:8001", None, False),
        ("http://evil.example", "same-origin", False),
        ("null", "cross-site", False),
        ("http://evil127.0.0.1:8000", None, False),
        (BASE, "same-origin", True),
        ("null", "same-origin", True),
        ("null", None, True),
    ],
)
def test_a_form_of_another_site_is_refused(
    guarded: TestClient, origin: str | None, site: str | None, own: bool
) -> None:
    headers = {"origin": origin, "sec_fetch_site": site}
    given = {name: value for name, value in headers.items() if value}
    for path in ("/sql", "/api/sql", "/api/sql.csv"):
        answer = post(guarded, path, RUN, **given)
        assert answer.status_code == (200 if own else 403)
        assert ("42" in answer.text) == own


def test_a_form_needs_the_token_of_this_process(guarded: TestClient, visit: Visit) -> None:
    assert visit("sqlite:///nothing.db") is not guarded
    for token in ("", "x", "é", "A" * 43):
        answer = guarded.post("/api/sql", data={"q": RUN, "token": token})
        assert answer.status_code == 403
        assert "not one of this server" in answer.json()["error"]


def test_a_form_has_bounds(guarded: TestClient) -> None:
    assert post(guarded, "/api/sql", "x" * 20_000).status_code == 400
    assert guarded.post("/api/sql", content=b"q=1&\xff\xfe%zz=&&;").status_code == 403


@pytest.mark.parametrize(
    ("host", "listening", "own"),
    [
        ("127.0.0.1:8000", "127.0.0.1", True),
        ("localhost:8000", "127.0.0.1", True),
        ("LOCALHOST", "127.0.0.1", True),
        ("[::1]:8000", "127.0.0.1", True),
        ("evil.example", "127.0.0.1", False),
        ("127.0.0.1.evil.example", "127.0.0.1", False),
        ("localhost.evil.example:8000", "127.0.0.1", False),
        ("192.168.0.7:8000", "127.0.0.1", False),
        ("192.168.0.7:8000", "0.0.0.0", True),
        ("evil.example:8000", "0.0.0.0", False),
        ("lab:8000", "lab", True),
        ("127.0.0.1:80x", "127.0.0.1", False),
        ("[::1", "127.0.0.1", False),
        ("[::1]x", "127.0.0.1", False),
        ("", "127.0.0.1", False),
        ("user@localhost", "127.0.0.1", False),
    ],
)
def test_only_names_of_this_server_are_answered(host: str, listening: str, own: bool) -> None:
    assert is_own([host], listening) is own
    assert not is_own([], listening)
    assert not is_own([host, host], listening)


def test_a_foreign_host_sees_nothing(guarded: TestClient) -> None:
    for path in ("/", "/api/grid", "/static/style.css"):
        answer = guarded.get(path, headers={"host": "evil.example"})
        assert answer.status_code == 421
        assert "dopt" not in answer.text


def test_a_foreign_site_may_link_but_not_load(guarded: TestClient) -> None:
    cross = {"sec-fetch-site": "cross-site"}
    assert guarded.get("/api/grid", headers=cross).status_code == 403
    image = {**cross, "sec-fetch-mode": "no-cors", "sec-fetch-dest": "image"}
    assert guarded.get("/static/icon.svg", headers=image).status_code == 403
    frame = {**cross, "sec-fetch-mode": "navigate", "sec-fetch-dest": "iframe"}
    assert guarded.get("/", headers=frame).status_code == 403
    visit = {**cross, "sec-fetch-mode": "navigate", "sec-fetch-dest": "document"}
    assert guarded.get("/", headers=visit).status_code == 200


def test_it_only_reads(guarded: TestClient) -> None:
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "BREW"):
        for path in ("/", "/curves", "/api/grid", "/static/style.css"):
            answer = guarded.request(method, path)
            assert answer.status_code == 405, (method, path)
            assert answer.headers["allow"] == "GET, HEAD"
    assert guarded.head("/").status_code == 200


def test_every_answer_carries_the_headers(guarded: TestClient) -> None:
    for path in ("/", "/nothing", "/api/nothing", "/static/style.css"):
        headers = guarded.get(path).headers
        policy = headers["content-security-policy"]
        for directive in ("default-src 'none'", "script-src 'self'", "frame-ancestors 'none'"):
            assert directive in policy, path
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize(
    "name",
    [
        "nothing.png",
        "..%2Fsecret.txt",
        "%2e%2e%2fsecret.txt",
        "..\\secret.txt",
        "icon.svg%00.txt",
        "%2Fetc%2Fpasswd",
    ],
)
def test_no_other_file_is_served(guarded: TestClient, name: str) -> None:
    for folder in ("static", "static/js"):
        answer = guarded.get(f"/{folder}/{name}")
        assert answer.status_code == 404
        assert "secret" not in answer.text.replace("secret.txt", "")
        assert "root:" not in answer.text


def test_addresses_have_bounds(guarded: TestClient) -> None:
    assert guarded.get("/sql?q=" + "x" * 20_000).status_code == 414


TEXTS = st.text(max_size=30) | st.sampled_from(
    ["pendulum", "d_optimal", "loss", "-1", "1e400", "[null, 1]", "[1, 2]", "\0", "%", "'", "desc"]
)
NAMES = st.sampled_from(
    [
        *("env", "policy", "width", "status", "seed", "config", "launch", "sort", "order", "page"),
        *("column", "x", "diverged", "where", "q", "hide"),
    ]
)
PAGES = ("/", "/curves", "/trials", "/sql")
DATA = ("grid", "curves", "trials", "sql")
TABLES = ("curves.csv", "sql.csv")
PATHS = st.sampled_from([*PAGES, *(f"/api/{name}" for name in (*DATA, *TABLES))]) | st.builds(
    lambda base, tail: base + tail,
    st.sampled_from(["/trials/", "/api/trials/", "/static/", "/"]),
    st.text(max_size=20),
)


@settings(
    max_examples=150,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    path=PATHS,
    query=st.dictionaries(NAMES | st.text(max_size=5), TEXTS, max_size=4),
    headers=st.dictionaries(
        st.sampled_from(["accept", "range", "if-none-match", "if-modified-since", "cookie"]),
        st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20),
        max_size=2,
    ),
)
def test_nothing_that_is_asked_breaks_a_page(
    guarded: TestClient, path: str, query: dict[str, str], headers: dict[str, str]
) -> None:
    address = quote(path, errors="replace") + "?" + urlencode(query, errors="replace")
    answer = guarded.get(address, headers=headers)  # an exception of a page is raised here
    assert answer.status_code in (200, 206, 304, 307, 400, 404, 405, 416), answer.text


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(query=st.binary(max_size=40).map(lambda raw: raw.hex()))
def test_bytes_that_are_no_text_break_nothing(guarded: TestClient, query: str) -> None:
    encoded = "".join(f"%{query[i : i + 2]}" for i in range(0, len(query), 2))
    for name in ("q", "env", "page", encoded):
        answer = guarded.get(f"/api/trials?{name}={encoded}")
        assert answer.status_code in (200, 400)
