"""Clients that wait, leave or never end keep no one from an answer, nor the server from its end."""

from __future__ import annotations

import logging
import os
import re
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from urllib.parse import urlencode, urlsplit

import httpx
import pytest
from starlette.routing import Route

from analysis.serve import app
from analysis.serve import server as serving
from analysis.serve.app import create_app
from tests.analysis.browser import chromium
from tests.orchestrate.faults.laboratory import alive, children, command_line
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS, until

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


def test_a_page_that_never_ends_does_not_keep_the_server(
    sqlite_grid: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "END_SECONDS", 0.5)
    left, asked = threading.Event(), threading.Event()

    def stuck(_: object) -> None:
        asked.set()
        assert left.wait(PATIENCE_SECONDS)

    pages = create_app(sqlite_grid)
    pages.routes.insert(0, Route("/stuck", stuck))
    server = serving.Server(pages, 0, leave=left.set)
    thread = threading.Thread(target=server.run)
    thread.start()
    until(lambda: server.started)
    port = server.servers[0].sockets[0].getsockname()[1]
    address = f"http://127.0.0.1:{port}"
    with connected(address, request(address, "/stuck")):
        assert asked.wait(PATIENCE_SECONDS)
        server.should_exit = True
        assert left.wait(PATIENCE_SECONDS)
        thread.join(PATIENCE_SECONDS)
    assert not thread.is_alive()
