"""A real Chromium, a served database, and a page that forgives nothing."""

from __future__ import annotations

import os
import re
import select
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page, Playwright, expect, sync_playwright

from analysis.serve.app import Server, create_app
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS, until

expect.set_options(timeout=1000 * PATIENCE_SECONDS)

PROGRAMS = ("chromium-headless-shell", "chromium")
"""Debian's packages; the first draws the same pages in half of the time."""

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]


def find() -> str:
    """Return the path of Chromium; skip without one, or fail where DOPT_REQUIRE_BROWSER=1."""
    for program in (os.environ.get("DOPT_CHROMIUM"), *PROGRAMS):
        if program and (path := shutil.which(program)):
            return path
    message = f"none of {', '.join(PROGRAMS)} is installed, and DOPT_CHROMIUM names no other one"
    if os.environ.get("DOPT_REQUIRE_BROWSER") == "1":
        pytest.fail(message)
    pytest.skip(message)


@contextmanager
def opened() -> Iterator[Browser]:
    """Start Chromium and end it."""
    path = find()
    playwright: Playwright
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield browser
        browser.close()


@contextmanager
def served(url: str, port: int = 0) -> Iterator[str]:
    """Serve a database from a thread of this process; yield the address."""
    server = Server(create_app(url), port)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        until(lambda: server.started)
        port = server.servers[0].sockets[0].getsockname()[1]
        yield f"http://127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join(PATIENCE_SECONDS)
        assert not thread.is_alive(), "the server does not end"


@contextmanager
def commanded(url: str) -> Iterator[str]:
    """Serve a database with the command itself on a free port; yield the address it prints."""
    command = [sys.executable, "-m", "analysis", "serve", "--db", url, "--port", "0"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        ready, _, _ = select.select([process.stdout], [], [], PATIENCE_SECONDS)
        assert ready, "the server says nothing"
        found = re.search(r"http://127\.0\.0\.1:\d+", process.stdout.readline())
        assert found
        yield found[0]
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=PATIENCE_SECONDS) == 0
        process.stdout.close()


@contextmanager
def strict_page(
    browser: Browser, address: str, complaint: str | None = None, **options: object
) -> Iterator[Page]:
    """Open a page of which every request goes to the server and nothing is complained of.

    ``complaint`` is a pattern of the messages that are expected, such as of a refused request.
    """
    faults: list[str] = []
    context = browser.new_context(base_url=address, **options)  # type: ignore[arg-type]
    context.set_default_timeout(1000 * PATIENCE_SECONDS)
    page = context.new_page()
    host = urlsplit(address).netloc

    def ask(asked: str) -> None:
        if urlsplit(asked).netloc != host:
            faults.append(f"asked elsewhere: {asked}")

    def hear(said: str) -> None:
        if complaint is None or not re.search(complaint, said):
            faults.append(said)

    page.on("request", lambda request: ask(request.url))
    page.on("console", lambda said: hear(said.text))
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("websocket", lambda socket: faults.append(f"socket: {socket.url}"))
    yield page
    context.close()
    assert not faults
