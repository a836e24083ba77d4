"""Requests of other sites, and whatever else may be asked."""

from __future__ import annotations

from collections.abc import Callable
from urllib.parse import quote, urlencode

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient

from analysis.serve.app import is_own


@pytest.fixture
def guarded(sqlite_grid: str, visit: Callable[..., TestClient]) -> TestClient:
    return visit(sqlite_grid)


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


def test_the_page_that_was_removed_names_its_successor(guarded: TestClient) -> None:
    answer = guarded.get("/sql?q=SELECT 1")
    assert answer.status_code == 404
    assert "python -m orchestrate query" in answer.text


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
    assert guarded.get("/trials?env=" + "x" * 20_000).status_code == 414


TEXTS = st.text(max_size=30) | st.sampled_from(
    ["pendulum", "d_optimal", "loss", "-1", "1e400", "[null, 1]", "[1, 2]", "\0", "%", "'", "desc"]
)
NAMES = st.sampled_from(
    [
        *("env", "policy", "width", "status", "seed", "config", "launch", "sort", "order", "page"),
        *("column", "x", "diverged", "where", "q", "hide"),
    ]
)
PAGES = ("/", "/curves", "/trials")
DATA = ("grid", "curves", "trials", "curves.csv")
PATHS = st.sampled_from([*PAGES, *(f"/api/{name}" for name in DATA)]) | st.builds(
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
