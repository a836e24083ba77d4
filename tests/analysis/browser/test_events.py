"""The event stream: what it says, when it ends, and what open pages cost the database."""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from collections.abc import AsyncIterator, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, aclosing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import httpx
import pytest
from playwright.sync_api import Browser, expect

from analysis.serve import web
from analysis.serve.web import Database, Events, read_progress
from orchestrate.store import Store
from tests.analysis.browser import chromium, grids
from tests.analysis.synthetic import fake_result, make_grid
from tests.waiting import PATIENCE_SECONDS

T = TypeVar("T")


def run(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run in a thread: in this one the browser of other tests may have a loop that runs."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, coroutine).result()


@contextmanager
def heard(address: str) -> Iterator[Iterator[tuple[str, Any]]]:
    """Yield the events of a server, each with its content."""
    with httpx.stream("GET", f"{address}/api/events", timeout=PATIENCE_SECONDS) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        lines = (line for line in answer.iter_lines() if line and not line.startswith(":"))
        yield (
            (name.removeprefix("event: "), json.loads(data.removeprefix("data: ")))
            for name, data in zip(lines, lines, strict=False)
        )


def test_a_change_is_an_event(url: str) -> None:
    specs = make_grid(("pendulum",), ("random",), range(2), **grids.SHORT)
    with (
        Store.open(url) as store,
        chromium.served(url) as address,
        heard(address) as stream,
    ):
        assert next(stream)[1]["total"] == 0
        launch = grids.begin(store)
        store.register(launch, specs)
        while (said := next(stream))[1]["total"] == 0:
            pass
        assert said[0] == "progress"
        grids.finish(store, launch, specs[0])
        assert next(stream)[1]["ended"] == 1


def test_it_says_that_the_database_is_gone_and_back(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    with chromium.served(url) as address, heard(address) as stream:
        name, content = next(stream)
        assert name == "unavailable"
        assert "There is no results database" in content["error"]
        grids.one_trial(f"sqlite:///{tmp_path}/new.db")
        shutil.move(tmp_path / "new.db", tmp_path / "results.db")
        name, content = next(stream)
        assert (name, content["total"]) == ("progress", 1)


def test_an_open_stream_does_not_keep_the_server(sqlite_grid: str) -> None:
    with ExitStack() as stack:
        with chromium.served(sqlite_grid) as address:
            stream = stack.enter_context(heard(address))
            assert next(stream)[0] == "progress"
        assert list(stream) == []


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
