"""Databases that are missing, empty, tiny, diverged, old, or made anew under the server."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

from orchestrate.store import Reader, Store
from tests.analysis.browser import grids
from tests.analysis.synthetic import make_grid

PAGES = ("/", "/curves", "/trials", "/sql")
Visit = Callable[..., TestClient]


class Markup(HTMLParser):
    """Finds what the content security policy would block, and unlabelled controls."""

    def __init__(self) -> None:
        super().__init__()
        self.faults: list[str] = []
        self.headings = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.headings += tag == "h1"
        if tag == "script" and "src" not in given:
            self.faults.append("inline script")
        self.faults += [name for name in given if name == "style" or name.startswith("on")]
        for name in ("src", "href", "action"):
            if str(given.get(name, "/")).startswith(("http", "//")):
                self.faults.append(f"foreign {name}")
        if tag == "th" and "scope" not in given:
            self.faults.append("th without scope")
        if tag == "img" and "alt" not in given:
            self.faults.append("img without alt")


def check(client: TestClient, path: str) -> str:
    """Return a page that is well made."""
    answer = client.get(path)
    assert answer.status_code == 200, f"{path}: {answer.text}"
    markup = Markup()
    markup.feed(answer.text)
    assert not markup.faults, path
    assert markup.headings == 1, path
    return answer.text


def test_every_page_of_a_mixed_grid_is_well_made(client: TestClient) -> None:
    for path in (*PAGES, "/sql?q=SELECT env FROM v_trial"):
        assert "read-only" in check(client, path)
    for row in client.get("/api/trials").json()["rows"]:
        check(client, f"/trials/{row['trial_key']}")


def test_an_empty_database_says_so(url: str, visit: Visit) -> None:
    grids.nothing(url)
    client = visit(url)
    for path in PAGES:
        check(client, path)
    assert "has no trials yet" in client.get("/").text
    assert "has no trials yet" in client.get("/curves").text
    assert client.get("/api/grid").json()["progress"]["total"] == 0
    assert client.get("/api/curves").status_code == 400


def test_one_trial_has_a_curve_and_no_interval(url: str, visit: Visit) -> None:
    grids.one_trial(url)
    client = visit(url)
    for path in PAGES:
        check(client, path)
    (curve,) = client.get("/api/curves").json()["curves"]
    assert len(curve["values"]) == 40
    assert curve["low"] == [None] * 40


def test_where_all_diverged_there_is_no_mean(url: str, visit: Visit) -> None:
    grids.all_diverged(url)
    client = visit(url)
    for path in PAGES:
        check(client, path)
    for curve in client.get("/api/curves").json()["curves"]:
        assert curve["values"] == [None] * 40
        assert curve["count"] == "0/3, 3 diverged"
    assert "3 diverged" in client.get("/").text
    for row in client.get("/api/trials").json()["rows"]:
        check(client, f"/trials/{row['trial_key']}")
        arrays = client.get(f"/api/trials/{row['trial_key']}/arrays").json()
        assert arrays["loss"][-1] is None


def test_a_trial_with_limits_shows_bounds_and_what_is_beyond(url: str, visit: Visit) -> None:
    grids.with_limits(url)
    client = visit(url)
    with Reader.open(url) as reader:
        (config,) = reader.configs()
        first, second = reader.trials(config.config_key)
        states = reader.trajectory(config.config_key, first.seed).states[1:]
    beyond = (np.abs(states[:, 0]) > 0.1) | (states[:, 3] > 9.0)
    page = client.get(f"/trials/{first.trial_key}").text
    assert f"<dd>{np.count_nonzero(beyond)} of 40</dd>" in page
    assert "farthest beyond limits" in page
    assert "counted only" in page
    bounded = client.get(f"/api/trials/{first.trial_key}/arrays").json()["bounded"]
    assert [one["label"] for one in bounded] == ["y [m]", "φ̇ [rad/s]"]
    assert [one["bounds"] for one in bounded] == [[-0.1, 0.1], [None, 9.0]]
    assert bounded[0]["values"] == states[:, 0].tolist()
    arrays = client.get(f"/api/trials/{second.trial_key}/arrays").json()
    assert arrays["bounded"][0]["values"][17:] == [None] * 23
    assert " of 17</dd>" in client.get(f"/trials/{second.trial_key}").text


def test_a_database_may_come_later_and_be_made_anew(tmp_path: Path, visit: Visit) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    client = visit(url)
    for path in ("/", "/trials", "/api/grid", "/api/curves"):
        answer = client.get(path)
        assert answer.status_code == 503
        assert "There is no results database" in answer.text
    assert not (tmp_path / "results.db").exists()
    assert "data-retry" in client.get("/").text
    grids.one_trial(url)
    assert client.get("/api/grid").json()["progress"]["total"] == 1
    for path in tmp_path.glob("results.db*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert client.get("/").status_code == 503
    grids.all_diverged(url)
    assert client.get("/api/grid").json()["progress"]["total"] == 6


def test_an_old_schema_is_one_sentence(tmp_path: Path, visit: Visit) -> None:
    import sqlite3

    with sqlite3.connect(tmp_path / "results.db") as connection:
        connection.execute("CREATE TABLE something (number INTEGER)")
    connection.close()
    answer = visit(f"sqlite:///{tmp_path}/results.db").get("/")
    assert answer.status_code == 503
    assert "is not a results database of this program" in answer.text


def test_a_damaged_file_is_one_sentence(tmp_path: Path, visit: Visit) -> None:
    (tmp_path / "results.db").write_bytes(b"no database at all" * 500)
    answer = visit(f"sqlite:///{tmp_path}/results.db").get("/")
    assert answer.status_code == 503
    assert "not a SQLite database" in answer.text


@pytest.mark.parametrize("way", ["retry", "commit"])
def test_what_a_launch_writes_is_seen_at_once(url: str, visit: Visit, way: str) -> None:
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(3), **grids.SHORT)
    client = visit(url)
    with Store.open(url) as store:
        launch = grids.begin(store)
        store.register(launch, specs)
        before = client.get("/api/grid").json()["progress"]
        assert before["launches_running"] == 1
        assert client.get("/api/curves").json()["curves"][0]["count"] == "0"
        if way == "commit":
            for spec in specs[:2]:
                grids.finish(store, launch, spec)
            after = client.get("/api/grid").json()["progress"]
            assert after["ended"] == 2
            found = client.get("/api/curves").json()["curves"][0]
            assert found["count"] == "2"
            grids.finish(store, launch, specs[2])
            newer = client.get("/api/curves").json()["curves"][0]
            assert newer["count"] == "3"
            assert newer["values"] != found["values"]
        else:
            (claim,) = store.claim(launch, [specs[0].trial_key])
            store.fail(claim, grids.FAILURE, grids.RUN)
            failed = client.get("/api/grid").json()["progress"]
            store.retry()
            after = client.get("/api/grid").json()["progress"]
            assert len({before["token"], failed["token"], after["token"]}) == 3
        assert after["token"] != before["token"]
