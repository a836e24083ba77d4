"""Several databases on one server: pages of each, and the configurations that two share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from starlette.testclient import TestClient

from analysis.serve.app import create_app
from tests.analysis.browser import chromium, grids
from tests.analysis.browser.conftest import BASE

DIFFERENT = "UPDATE trial SET final_loss = final_loss + 1 WHERE seed = 0"


@pytest.fixture
def urls(tmp_path: Path) -> list[str]:
    """Return the URLs of two databases of one name: one trial, and six that diverged."""
    made = []
    for folder, fill in (("old", grids.one_trial), ("new", grids.mixed)):
        (tmp_path / folder).mkdir()
        made.append(f"sqlite:///{tmp_path}/{folder}/results.db")
        fill(made[-1])
    return made


@pytest.fixture
def client(urls: list[str], tmp_path: Path) -> Iterator[TestClient]:
    app = create_app(urls[0], tmp_path, others=urls[1:])
    with TestClient(app, base_url=BASE) as opened:
        yield opened


def test_each_has_its_pages(client: TestClient) -> None:
    assert client.get("/api/trials").json()["total"] == 1
    assert client.get("/db/results-2/api/trials").json()["total"] == 48
    for path in (
        "/",
        "/curves",
        "/trials",
        "/compare",
        "/control",
        "/launches",
        "/figures",
        "/sql",
    ):
        page = client.get(f"/db/results-2{path}")
        assert page.status_code in (200, 400), path
        assert 'data-base="/db/results-2"' in page.text
        links = page.text.split("</header>")[1].split('href="')[1:]
        assert all(link.startswith(("/db/results-2/", "/static/", "#")) for link in links), path
        assert 'href="/databases"' in page.text
    assert client.get("/db/none/trials").status_code == 404
    assert client.get("/db/results-2/api/none").json()["error"].startswith("This page does not")


def test_a_missing_one_leaves_the_other(tmp_path: Path, urls: list[str]) -> None:
    missing = f"sqlite:///{tmp_path}/missing.db"
    with TestClient(create_app(urls[0], tmp_path, others=[missing]), base_url=BASE) as client:
        assert client.get("/").status_code == 200
        page = client.get("/db/missing/trials")
        assert (page.status_code, "data-retry" in page.text) == (503, True)
        assert client.get("/databases").status_code == 503


def test_configurations_are_side_by_side(client: TestClient) -> None:
    found = client.get("/api/databases").json()
    assert (found["first"], found["second"]) == ("results", "results-2")
    assert found["alone"] == [0, 11]
    (row,) = found["rows"]
    assert (row["env"], row["policy"]) == ("pendulum", "d_optimal")
    assert [side["n_used"] for side in row["sides"]] == [1, 4]
    assert (row["common"], row["equal"]) == (1, 1)
    for side in row["sides"]:
        trials = client.get(f"{side['base']}/api/trials?config={side['config_key']}").json()
        losses = [one["final_loss"] for one in trials["rows"]]
        assert side["loss"] == pytest.approx(sum(losses) / len(losses))
    page = client.get("/databases").text
    assert "0 configurations only in results, 11 configurations only in results-2." in page
    turned = client.get("/api/databases?first=results-2").json()
    assert (turned["second"], turned["alone"]) == ("results", [11, 0])
    refused = client.get("/databases?first=nothing")
    assert refused.status_code == 400
    assert "&#39;first&#39; is &#39;nothing&#39;, which is not valid" in refused.text


def test_another_number_is_not_equal(urls: list[str], client: TestClient) -> None:
    import sqlite3

    with sqlite3.connect(urls[1].removeprefix("sqlite:///")) as connection:
        connection.execute(DIFFERENT)
    connection.close()
    (row,) = client.get("/api/databases").json()["rows"]
    assert (row["common"], row["equal"]) == (1, 0)


def test_one_database_has_no_such_page(
    sqlite_grid: str, visit: Callable[[str], TestClient]
) -> None:
    client = visit(sqlite_grid)
    assert "Only one database is served" in client.get("/databases").text
    assert "Side by side" not in client.get("/").text


@pytest.mark.browser
@pytest.mark.xdist_group("browser")
def test_from_one_to_the_other(browser: Browser, urls: list[str], figures: Path) -> None:
    with (
        chromium.served(urls[0], figures, others=urls[1:]) as address,
        chromium.strict_page(browser, address) as page,
    ):
        page.goto("/")
        expect(page.locator("#state-text")).to_have_text("1 of 1 trials ended")
        page.get_by_role("link", name="results-2", exact=True).click()
        expect(page.locator("#state-text")).to_have_text("45 of 48 trials ended, 1 failed")
        page.get_by_role("link", name="Curves", exact=True).click()
        expect(page.locator("#legend tbody tr")).to_have_count(5)
        page.get_by_role("link", name="Side by side").click()
        expect(page.locator("tbody tr")).to_have_count(1)
        page.get_by_role("link", name="results-2: trials of pendulum").click()
        expect(page.locator("tbody tr")).to_have_count(4)
        page.locator("tbody a").first.click()
        page.wait_for_selector("#charts[data-drawn]")
        assert "/db/results-2/trials/" in page.url
