"""Numbers and states that the pages show."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from playwright.sync_api import Browser
from starlette.testclient import TestClient

from analysis.data.matching import Filter
from analysis.data.selection import select
from analysis.serve import pages
from analysis.stats.curves import Axis, PlotOptions, measure_curves, tabulate_curves
from analysis.tables.comparisons import summarise
from dopt import Explorer
from orchestrate.store import LaunchRecord, Reader, Store
from tests.analysis.browser import chromium, grids
from tests.analysis.synthetic import make_grid
from tests.dopt.explorer.plants import MOTOR, drive
from tests.orchestrate.store.databases import execute


def test_the_grid_has_the_means_of_the_summary(client: TestClient, reader: Reader) -> None:
    found = client.get("/api/grid").json()
    assert [group["env"] for group in found["environments"]] == ["pendulum", "cartpole"]
    rows = summarise(reader, select(reader, Filter())).to_dict("records")
    cells = {
        (group["env"], one["configurations"][0]["policy"]): one["configurations"]
        for group in found["environments"]
        for row in group["rows"]
        if row["width"] in (16, None)
        for one in row["cells"]
        if one["configurations"]
    }
    assert len(cells) == len(rows) == 10
    for row in rows:
        (shown,) = cells[row["env"], row["policy"]]
        assert shown["loss"] == row["loss"]
        assert shown["loss_2se"] == row["loss_2se"]
        assert shown["n_used"] == row["n"]
    (diverged,) = cells["cartpole", "random"]
    assert diverged["counts"] == {"done": 3, "diverged": 1}
    (failed,) = cells["pendulum", "periodic"]
    assert failed["counts"] == {"done": 2, "failed": 1, "pending": 1}
    assert (failed["ended"], failed["n"]) == (3, 4)


def test_the_usual_configuration_is_the_first_of_its_cell(
    visit: Callable[..., TestClient], variants_grid: str
) -> None:
    pendulum, _ = visit(variants_grid).get("/api/grid").json()["environments"]
    (row,) = pendulum["rows"]
    labels = [one["label"] for one in row["cells"][0]["configurations"]]
    differing = ("D-optimal", "task control", "γ=3", "adam_replay", "rff")
    assert [words in label for words, label in zip(differing, labels, strict=True)] == [True] * 5


@pytest.mark.parametrize("column", ["loss", "reachable_loss"])
def test_curves_equal_figure_1(client: TestClient, reader: Reader, column: str) -> None:
    asked = f"env=cartpole&column={column}&x=seconds"
    found = client.get(f"/api/curves?{asked}").json()
    expected = measure_curves(
        reader, select(reader, Filter(("cartpole",))), column, PlotOptions(Axis.SECONDS)
    )
    assert [curve["policy"] for curve in found["curves"]] == [one.policy for one in expected]
    for curve, one in zip(found["curves"], expected, strict=True):
        for key, name in (("values", "centre"), ("low", "low"), ("high", "high")):
            shown = np.array(curve[key], dtype=float)
            np.testing.assert_array_equal(shown, getattr(one.band, name))
        assert curve["count"] == one.count
    np.testing.assert_array_equal(found["x"], expected[0].x)
    assert found["unit"] == expected[0].unit == "m/s², rad/s²"
    assert found["missing"][0]["policy"] == "periodic"
    table = pd.read_csv(io.StringIO(client.get(f"/api/curves.csv?{asked}").text))
    pd.testing.assert_frame_equal(table, tabulate_curves(expected), check_dtype=False, rtol=1e-15)


def test_a_width_and_a_condition_choose_other_configurations(client: TestClient) -> None:
    for asked in ("width=4", "where=model.width=4"):
        curves = client.get(f"/api/curves?env=pendulum&{asked}").json()["curves"]
        assert [curve["policy"] for curve in curves] == ["d_optimal", "oracle", "random"]
    refused = client.get("/api/curves?env=pendulum&width=5")
    assert refused.status_code == 400
    assert "the field Where model.width=" in refused.json()["error"]
    assert "fits no stored configuration" in refused.json()["error"]


_TIMES = """
SELECT plan_us, learn_us FROM step JOIN trial USING (trial_id) WHERE trial_key = :trial_key
"""


def test_a_trial_shows_what_is_stored(client: TestClient, reader: Reader) -> None:
    (config,) = [c for c in reader.configs() if (c.env, c.policy) == ("cartpole", "d_optimal")]
    row = reader.trials(config.config_key)[1]
    found = client.get(f"/api/trials/{row.trial_key}").json()
    assert found["trial"]["final_loss"] == row.final_loss
    assert found["config"]["model.width"] == 16
    assert [one["outcome"] for one in found["attempts"]] == ["done"]
    assert found["launches"][0]["host"] == "h"
    arrays = client.get(f"/api/trials/{row.trial_key}/arrays").json()
    losses = reader.curves(config.config_key).values
    assert arrays["loss"] == losses[1].tolist()
    assert arrays["unit"] == "m/s², rad/s²"
    trajectory = reader.trajectory(config.config_key, row.seed)
    assert arrays["inputs"][0]["values"] == trajectory.inputs[:, 0].tolist()
    frequency, density = (np.array(arrays["spectrum"][key]) for key in ("frequency", "density"))
    assert len(frequency) == len(density) == 19
    assert 0.4 < arrays["spectrum"]["eigenfrequency"] < 0.7
    assert len(arrays["phase"]["x"]) >= 41
    us = np.array([*map(tuple, reader.rows(_TIMES, trial_key=row.trial_key))]).sum(axis=1)
    found = arrays["durations"]
    edges = np.array([*found["us"], found["us"][-1] * 10**0.1]) / 10**0.05
    assert found["steps"] == np.histogram(us, edges)[0].tolist()
    np.testing.assert_allclose(found["quantiles"], np.quantile(us, [0.5, 0.99, 1.0]))


def test_a_failed_trial_shows_its_traceback_as_text(client: TestClient) -> None:
    (row,) = client.get("/api/trials?status=failed").json()["rows"]
    page = client.get(f"/trials/{row['trial_key']}").text
    assert "&lt;script&gt;alert" in page
    assert "<script>alert" not in page
    assert "the &lt;b&gt;input&lt;/b&gt; is wrong" in page
    assert client.get(f"/api/trials/{row['trial_key']}/arrays").status_code == 404


def test_the_token_changes_with_the_grid_alone(client: TestClient) -> None:
    first, second = (client.get("/api/grid").json()["progress"] for _ in range(2))
    assert first == second
    assert first["counts"] == {"diverged": 1, "done": 43, "failed": 1, "pending": 3}
    assert (first["ended"], first["total"]) == (45, 48)


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


def test_a_database_may_come_later_and_be_made_again(tmp_path: Path, visit: Visit) -> None:
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


def test_a_database_of_another_program_is_one_sentence(tmp_path: Path, visit: Visit) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    execute(url, "CREATE TABLE something (number INTEGER)")
    answer = visit(url).get("/")
    assert answer.status_code == 503
    assert "is not a results database of this program" in answer.text


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


@pytest.mark.parametrize("order", ["asc", "desc"])
def test_pages_hold_every_trial_once_in_order(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, order: str
) -> None:
    monkeypatch.setattr(pages, "PAGE_ROWS", 20)
    for sort in pages.COLUMNS:
        found = [
            client.get(f"/api/trials?sort={sort}&order={order}&page={page}").json()
            for page in (1, 2, 3, 4)
        ]
        assert [len(one["rows"]) for one in found] == [20, 20, 8, 0]
        assert [(one["total"], one["last"]) for one in found] == [(48, 3)] * 4
        rows = [row for one in found for row in one["rows"]]
        assert len({row["trial_key"] for row in rows}) == 48
        known = [row[sort] for row in rows if row[sort] is not None]
        assert known == sorted(known, reverse=order == "desc"), sort
        assert all(row[sort] is None for row in rows[len(known) :])
    first, middle, last, beyond = (client.get(f"/trials?page={n}").text for n in (1, 2, 3, 4))
    assert ['rel="prev"' in page for page in (first, middle, last, beyond)] == [0, 1, 1, 1]
    assert ['rel="next"' in page for page in (first, middle, last, beyond)] == [1, 1, 0, 0]
    assert "The list has 3 pages" in beyond


def test_filters_narrow_the_list(client: TestClient) -> None:
    found = client.get("/api/trials?env=cartpole&policy=random").json()
    assert (found["total"], len(found["rows"])) == (4, 4)
    assert client.get("/api/trials?status=diverged").json()["total"] == 1
    assert client.get("/api/trials?width=4").json()["total"] == 8
    assert client.get("/api/trials?seed=3").json()["total"] == 12
    assert client.get("/api/trials?launch=2").json()["total"] == 1
    key = client.get(f"/api/trials/{found['rows'][0]['trial_key']}").json()["trial"]["config_key"]
    assert client.get(f"/api/trials?config={key}").json()["total"] == 4
    assert client.get("/api/trials?config=' OR 1=1 --").json()["total"] == 0
    assert "No trial matches" in client.get("/trials?env=cartpole&width=4").text


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ("sort=loss", "did you mean 'best_loss'?"),
        ("env=pendulun", "did you mean 'pendulum'?"),
        ("policy=x", "choose one of d_optimal, oracle, uniform, periodic, random."),
        ("width=many", "a whole number of 1"),
        ("page=0", "a whole number of 1"),
        ("status=%00", "zero character"),
    ],
)
def test_a_wrong_request_is_one_sentence(client: TestClient, asked: str, sentence: str) -> None:
    answer = client.get(f"/api/trials?{asked}")
    assert answer.status_code == 400
    assert sentence in answer.json()["error"]
    assert client.get(f"/trials?{asked}").status_code == 400


def test_its_page_follows_it(browser: Browser, sqlite_url: str) -> None:
    with Explorer(MOTOR, policy="random", steps=500) as explorer:
        drive(explorer, 60)
        explorer.save(sqlite_url)
        with Reader.open(sqlite_url) as reader:
            [(key,)] = reader.query("SELECT trial_key FROM trial")
        with chromium.served(sqlite_url) as address, chromium.strict_page(browser, address) as page:
            page.goto(f"{address}/trials/{key}")
            page.wait_for_selector("#charts[data-drawn]")
            assert "running, 60 of 500 steps" in page.inner_text("#trial-state")
            drive(explorer, 60)
            explorer.save(sqlite_url)
            page.wait_for_selector("text=running, 120 of 500 steps")
            page.wait_for_selector("#charts[data-drawn='120']")
            assert page.locator("#loss canvas").count() == 1, "the chart before is gone"
            assert "prequential loss" in page.inner_text("#outcome")


def test_its_curve_is_a_running_median_among_points(browser: Browser, sqlite_url: str) -> None:
    with Explorer(MOTOR, policy="random", steps=500) as explorer:
        drive(explorer, 40)
        explorer.save(sqlite_url)
        errors = explorer.errors
    with chromium.served(sqlite_url) as address, chromium.strict_page(browser, address) as page:
        [curve] = page.request.get(f"{address}/api/curves?env=plant").json()["curves"]
        np.testing.assert_allclose(curve["points"], errors)
        assert curve["values"][20] == np.median(errors[8:33])
        assert "low" not in curve
        page.goto(f"{address}/curves?env=plant")
        page.wait_for_selector("#chart[data-shown=random] canvas")
        assert page.inner_text("#lead").startswith("Prequential loss against time")
        assert "Points: each step. Lines: running median" in page.inner_text("#band")
        assert not page.is_visible("[name=column]")


def test_launches_and_failures_come_from_the_database(client: TestClient) -> None:
    found = client.get("/api/grid").json()
    assert [one["launch_id"] for one in found["launches"]] == [2, 1]
    failed, filled = found["launches"]
    assert (failed["finished"], failed["failed"], failed["state"]) == (0, 1, "done")
    assert (filled["finished"], filled["failed"]) == (44, 0)
    [kind] = found["failures"]
    assert (kind["type"], kind["cause"], kind["trials"]) == ("ValueError", "exception", 1)
    assert kind["traceback"] == grids.TRACEBACK
    page = client.get("/").text
    assert "the &lt;b&gt;input&lt;/b&gt; is wrong" in page
    assert 'href="/trials?launch=2"' in page
    assert [row["status"] for row in client.get("/api/trials?launch=2").json()["rows"]] == [
        "failed"
    ]


def test_what_a_launch_did_is_told(visit: Callable[..., TestClient], url: str) -> None:
    """One that runs, one that was killed, a worker, and one that left its grid."""
    plain = LaunchRecord(argv=["launch.py", "-m", "env=glob(*)"], overrides=[], host="here", pid=1)
    records = (
        plain,
        replace(plain, argv=["orchestrate", "work", "--until", "55m"]),
        replace(plain, overrides=["launch.detach=true"]),
    )
    with Store.open(url) as store:
        for record in records:
            store.end_launch(store.begin_launch(record), "done")
        grids.begin(store)
        client = visit(url)
        found = client.get("/api/grid").json()["launches"]
        assert [one["kind"] for one in found] == ["launch", "registration", "worker", "launch"]
        assert [one["state"] for one in found] == ["running", "done", "done", "done"]
        assert found[-1]["command"] == "launch.py -m 'env=glob(*)'"
        token = client.get("/api/grid").json()["progress"]["token"]
        store.end_launch(store.begin_launch(plain), "failed")
        assert client.get("/api/grid").json()["progress"]["token"] != token


def test_a_launch_that_was_killed_is_lost(
    visit: Callable[..., TestClient], sqlite_url: str
) -> None:
    with Store.open(sqlite_url) as store:
        store.register(grids.begin(store), make_grid(("pendulum",), ("random",), range(1)))
    [one] = visit(sqlite_url).get("/api/grid").json()["launches"]
    assert (one["state"], one["seconds"]) == ("lost", None)
