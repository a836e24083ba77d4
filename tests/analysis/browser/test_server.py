"""The command, its connections and the event stream."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, aclosing, contextmanager
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlencode, urlsplit

import httpx
import pytest
from playwright.sync_api import Browser, expect

from analysis.cli import main
from analysis.serve import app, web
from analysis.serve import app as serving
from analysis.serve.web import Cache, Database, Events, read_progress
from orchestrate.store import Store
from orchestrate.store.records import jsonable
from tests.analysis.browser import chromium, grids
from tests.analysis.synthetic import fake_result, make_grid
from tests.orchestrate.faults.laboratory import alive, children, command_line
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS, until


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--port", "99999"], "expected is a number of 0 to 65535"),
        (["--port", "many"], "invalid int value: 'many'"),
        (["--host", "203.0.113.7"], "cannot listen at 203.0.113.7"),
        (["--host", "no.such.host.invalid"], "cannot listen at no.such.host.invalid"),
        (["--db", "nothing"], "The database URL cannot be read"),
        (["--where", "model.width=3"], "--where"),
        (["--figures", "figures"], "open README.md"),
    ],
)
def test_a_wrong_request_is_one_sentence(
    capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert main(["serve", *arguments]) == 2
    captured = capsys.readouterr()
    assert sentence in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_a_port_that_is_taken_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        assert main(["serve", "--port", str(listening.getsockname()[1])]) == 2
    assert "--port 0 takes any free port" in capsys.readouterr().err


def test_without_its_libraries_it_says_which_to_install(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "analysis.serve.app", raising=False)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert main(["serve"]) == 2
    assert "pip install 'dopt-exploration[serve]'" in capsys.readouterr().err


def test_a_kept_value_is_not_computed_again_until_it_is_forgotten() -> None:
    memory, seen = Cache(size=2), []

    def value(key: str) -> str:
        return memory.get_or_compute(key, lambda: seen.append(key) or key.upper())

    assert [value(key) for key in ("a", "a", "b", "a", "c", "a", "b")] == list("AABACAB")
    assert seen == ["a", "b", "c", "b"]


def test_numbers_that_are_not_finite_are_null() -> None:
    found = jsonable({"a": [float("nan"), float("inf"), 1.5], "b": (True, None, Path("x"))})
    assert found == {"a": [None, None, 1.5], "b": [True, None, "x"]}


ENDLESS = "SELECT instr(hex(zeroblob(30000000)), hex(zeroblob(15000000)) || '1')"
LARGE = "SELECT hex(zeroblob(15000000))"
HALF = b"GET / HTTP/1.1\r\nHost: 127"


def connected(address: str, sent: bytes) -> socket.socket:
    place = urlsplit(address)
    assert place.hostname
    assert place.port
    opened = socket.create_connection((place.hostname, place.port), timeout=PATIENCE_SECONDS)
    opened.sendall(sent)
    return opened


def is_closed(connection: socket.socket) -> bool:
    """Return whether the server has closed a connection that it has not answered."""
    if not select.select([connection], [], [], 0)[0]:
        return False
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


def request(address: str, path: str, body: bytes | None = None) -> bytes:
    method, length = ("GET", 0) if body is None else ("POST", len(body))
    head = f"{method} {path} HTTP/1.1\r\nHost: {urlsplit(address).netloc}\r\n"
    return f"{head}Content-Length: {length}\r\n\r\n".encode() + (body or b"")


def asking(address: str, statement: str = ENDLESS) -> bytes:
    """Return a request of a statement, by default of one that takes hours."""
    page = httpx.get(f"{address}/sql", timeout=PATIENCE_SECONDS).text
    (token,) = re.findall(r'name="token" value="([\w-]+)"', page)
    return request(address, "/api/sql", urlencode({"q": statement, "token": token}).encode())


def queries(pid: int) -> list[int]:
    """Return the processes of statements."""
    return [one for one in children(pid) if "query_process" in command_line(one)]


@contextmanager
def opened(address: str) -> Iterator[None]:
    """Hold half a request, an event stream, and half a form."""
    form = request(address, "/api/sql", b"q=SELECT")[:-3]
    with (
        connected(address, HALF),
        connected(address, request(address, "/api/events")) as stream,
        connected(address, form),
        connected(address, b""),
    ):
        assert stream.recv(100).startswith(b"HTTP/1.1 200")
        yield


def test_ctrl_c_ends_the_server_whoever_is_connected(sqlite_grid: str) -> None:
    command = [sys.executable, "-m", "analysis", "serve", "--db", sqlite_grid, "--port", "0"]
    with (
        subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as server,
        ExitStack() as stack,
    ):
        stack.callback(server.kill)
        assert server.stdout
        (address,) = re.findall(r"http://127\.0\.0\.1:\d+", server.stdout.readline())
        stack.enter_context(opened(address))
        unread = stack.enter_context(connected(address, asking(address, LARGE)))
        assert unread.recv(1)
        asked = asking(address)
        for _ in range(4):  # two more than run at once
            stack.enter_context(connected(address, asked))
        until(lambda: len(queries(server.pid)) == 2)
        running = queries(server.pid)
        server.send_signal(signal.SIGINT)
        assert server.wait(PATIENCE_SECONDS) == 0
        until(lambda: not any(map(alive, running)))


def test_a_statement_ends_with_its_client(sqlite_grid: str) -> None:
    with chromium.served(sqlite_grid) as address:
        client = connected(address, asking(address))
        until(lambda: queries(os.getpid()))
        (running,) = queries(os.getpid())
        client.close()
        until(lambda: not alive(running))


def test_half_open_connections_are_few(sqlite_grid: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "MAX_WAITING", 3)
    with chromium.served(sqlite_grid) as address, ExitStack() as stack:
        held = [stack.enter_context(connected(address, HALF)) for _ in range(20)]
        until(lambda: sum(map(is_closed, held)) >= 17)
        assert httpx.get(address, timeout=PATIENCE_SECONDS).status_code == 200
        assert not is_closed(held[-1])


def test_half_a_request_is_given_up(sqlite_grid: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "REQUEST_SECONDS", 0.5)
    with chromium.served(sqlite_grid) as address, ExitStack() as stack:
        silent = stack.enter_context(connected(address, b""))
        slow = stack.enter_context(connected(address, HALF))
        second = stack.enter_context(connected(address, request(address, "/static/icon.svg")))
        answer = b""
        while b"</svg>" not in answer:
            answer += second.recv(2**16)
        second.sendall(HALF)

        def all_closed() -> bool:
            if not is_closed(slow):
                slow.send(b"7")  # a part at a time
            return all(map(is_closed, (silent, slow, second)))

        until(all_closed)


def test_streams_outlive_the_time_of_a_request(
    sqlite_grid: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "REQUEST_SECONDS", 0.2)
    with (
        chromium.served(sqlite_grid) as address,
        connected(address, request(address, "/api/events")) as stream,
        connected(address, HALF) as half,
    ):
        assert stream.recv(2**16)
        until(lambda: is_closed(half))
        assert not is_closed(stream)


def test_half_a_form_is_given_up(sqlite_grid: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(app, "FORM_SECONDS", 0.2)
    with chromium.served(sqlite_grid) as address:
        form = request(address, "/api/sql", b"q=SELECT")[:-3]
        with connected(address, form) as half:
            assert half.recv(2**16).startswith(b"HTTP/1.1 400")


def test_strangers_cannot_fill_the_log(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "_next", {})

    def passed(line: int, level: int = logging.WARNING) -> bool:
        return serving.seldom(logging.LogRecord("", level, "server.py", line, "", None, None))

    assert [passed(1), passed(1), passed(2), passed(1)] == [True, False, True, False]
    assert [passed(3, logging.ERROR), passed(3, logging.ERROR)] == [True, True]
    monkeypatch.setattr(serving, "LOG_SECONDS", -1.0)
    assert [passed(4), passed(4)] == [True, True]


T = TypeVar("T")


def run(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run in a thread: in this one the browser of other tests may have a loop that runs."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, coroutine).result()


def test_all_streams_share_one_reading(sqlite_grid: str, monkeypatch: pytest.MonkeyPatch) -> None:
    readings: list[float] = []

    def read(reader: Any) -> dict[str, Any]:
        readings.append(time.monotonic())
        return read_progress(reader) | {"n": len(readings)}

    monkeypatch.setattr(web, "read_progress", read)
    monkeypatch.setattr(web, "PERIOD", 0.05)

    async def follow(stream: AsyncIterator[str]) -> int:
        return len([await anext(stream) for _ in range(5)])

    async def follow_all() -> None:
        shared = Events(Database(sqlite_grid))
        streams = [shared.stream() for _ in range(50)]
        assert await asyncio.gather(*map(follow, streams)) == [5] * 50
        assert len(readings) <= 6
        for stream in streams:
            await stream.aclose()
        count = len(readings)
        await asyncio.sleep(0.5)
        assert len(readings) <= count + 1, "nobody listens any more"

    run(follow_all())


def test_a_silent_stream_says_that_it_is_alive(
    sqlite_grid: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "SILENCE", 0.05)

    async def follow() -> list[str]:
        shared = Events(Database(sqlite_grid))
        async with aclosing(shared.stream()) as stream:
            said = [await anext(stream) for _ in range(20)]
        shared.end()
        return said + [text async for text in shared.stream()]

    said = run(follow())
    assert web.COMMENT in said
    assert sum(text.startswith("event: progress") for text in said) == 1
    assert len(said) == 20, "a stream that is opened after the end ends at once"


def test_a_defect_ends_the_stream(sqlite_grid: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "read_progress", lambda _: {}["no such entry"])

    async def follow() -> None:
        async for _ in Events(Database(sqlite_grid)).stream():
            pass

    with pytest.raises(KeyError):
        run(follow())


@pytest.mark.browser
@pytest.mark.xdist_group("browser")
def test_the_page_of_a_trial_gets_charts_when_it_ends(browser: Browser, sqlite_url: str) -> None:
    (spec,) = make_grid(("pendulum",), ("random",), range(1), **grids.SHORT)
    with (
        Store.open(sqlite_url) as store,
        chromium.served(sqlite_url) as address,
        chromium.strict_page(browser, address) as page,
    ):
        launch = grids.begin(store)
        store.register(launch, [spec])
        page.goto(f"/trials/{spec.trial_key}")
        expect(page.locator("#waiting")).to_contain_text("This trial is pending")
        (claim,) = store.claim(launch, [spec.trial_key])
        expect(page.locator("#waiting")).to_contain_text("This trial is running")
        assert store.commit(claim, fake_result(spec), grids.RUN)
        expect(page.locator("#charts")).to_have_attribute("data-drawn", "40")


@pytest.mark.browser
@pytest.mark.xdist_group("browser")
def test_a_page_connects_again(browser: Browser, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    grids.one_trial(url)
    refused = "ERR_CONNECTION_REFUSED|ERR_INCOMPLETE_CHUNKED_ENCODING|ERR_EMPTY_RESPONSE"
    with chromium.served(url) as address:
        pass
    port = int(address.rpartition(":")[2])
    with chromium.strict_page(browser, address, complaint=refused) as page:
        with chromium.served(url, port):
            page.goto("/")
            expect(page.locator("#state-text")).to_have_text("1 of 1 trials ended")
        expect(page.locator("#state-text")).to_have_text("server not reachable")
        page.evaluate("window.same = true")
        grids.all_diverged(url)
        with chromium.served(url, port):
            expect(page.locator("#state-text")).to_have_text("6 of 6 trials ended")
            expect(page.locator("#grid")).to_contain_text("diverged")
            assert page.evaluate("window.same") is True, "the page was loaded again"


@pytest.mark.browser
@pytest.mark.xdist_group("browser")
def test_a_hidden_page_holds_no_connection(browser: Browser, address: str) -> None:
    hide = """hidden => {
      Object.defineProperty(document, 'hidden', { configurable: true, get: () => hidden });
      document.dispatchEvent(new Event('visibilitychange'));
    }"""
    with chromium.strict_page(browser, address) as page:
        asked: list[str] = []
        page.goto("/")
        expect(page.locator("#state-text")).to_contain_text("trials ended")
        with page.expect_event(
            "requestfailed", lambda request: request.url.endswith("/api/events")
        ):
            page.evaluate(hide, True)
        page.on("request", lambda request: asked.append(request.url))
        page.wait_for_timeout(2500)
        assert asked == []
        with page.expect_request("**/api/events"):
            page.evaluate(hide, False)
