"""The list of trials: every page of every order, forwards and backwards, on both databases."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from analysis.serve.trial_columns import COLUMNS
from tests.analysis.synthetic import fill, make_grid


def walk(client: TestClient, asked: str, way: str, start: str = "") -> list[list[dict[str, Any]]]:
    """Return the pages that follow each other in one direction."""
    pages, place = [], start
    while True:
        params = {"size": "25", **({} if not place else {way: place})}
        found = client.get(f"/api/trials?{asked}", params={**_asked(asked), **params}).json()
        pages.append(found["rows"])
        place = found["next" if way == "after" else "previous"]
        if not place or len(found["rows"]) < 25:
            return pages


def _asked(text: str) -> dict[str, str]:
    return dict(part.split("=") for part in text.split("&"))


@pytest.mark.parametrize("order", ["asc", "desc"])
@pytest.mark.parametrize("sort", COLUMNS)
def test_pages_hold_every_trial_once_in_order(client: TestClient, sort: str, order: str) -> None:
    pages = walk(client, f"sort={sort}&order={order}", "after")
    rows = [row for page in pages for row in page]
    assert len({row["trial_key"] for row in rows}) == len(rows) == 48
    known = [row[sort] for row in rows if row[sort] is not None]
    assert known == sorted(known, reverse=order == "desc")
    assert all(row[sort] is None for row in rows[len(known) :])
    back = client.get(
        "/api/trials",
        params={"sort": sort, "order": order, "size": "25", "before": _place(pages[1][0], sort)},
    ).json()
    assert back["rows"] == pages[0]


def _place(row: dict[str, Any], sort: str) -> str:
    return json.dumps([row[sort], row["trial_id"]])


def test_columns_that_tell_configurations_apart_are_shown(
    client: TestClient, visit: Callable[..., TestClient], variants_grid: str
) -> None:
    plain = client.get("/api/trials").json()["columns"]
    assert not {"model", "learner", "gamma", "task", "settings"} & set(plain)
    variants = visit(variants_grid)
    found = variants.get("/api/trials?env=pendulum&policy=d_optimal&seed=0&size=25").json()
    assert {"model", "learner", "gamma", "task"} <= set(found["columns"])
    assert "settings" not in found["columns"]
    names = ("model", "learner", "gamma", "task")
    rows = {tuple(row[name] for name in names) for row in found["rows"]}
    assert len(rows) == len(found["rows"]) == 5
    page = variants.get("/trials?policy=d_optimal").text
    assert "adam replay" in page
    one = variants.get("/api/trials?policy=random&env=quadrotor").json()["columns"]
    assert not {"model", "learner", "gamma", "task"} & set(one)


def test_settings_are_shown_where_no_other_column_differs(
    visit: Callable[..., TestClient], tmp_path: Path
) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    for noise in (0.01, 0.02):
        env = {"horizon": 40, "noise": noise}
        fill(url, make_grid(("pendulum",), ("random",), range(1), env=env))
    found = visit(url).get("/api/trials").json()
    assert found["columns"]["settings"] == "settings"
    assert {row["settings"] for row in found["rows"]} == {"σ=0.01", "σ=0.02"}


def test_filters_narrow_the_list(client: TestClient) -> None:
    found = client.get("/api/trials?env=cartpole&policy=random").json()
    assert (found["total"], len(found["rows"])) == (4, 4)
    assert client.get("/api/trials?status=diverged").json()["total"] == 1
    assert client.get("/api/trials?width=4").json()["total"] == 8
    assert client.get("/api/trials?seed=3").json()["total"] == 12
    assert client.get("/api/trials?launch=2").json()["total"] == 1
    config = found["rows"][0]
    key = client.get(f"/api/trials/{config['trial_key']}").json()["trial"]["config_key"]
    assert client.get(f"/api/trials?config={key}").json()["total"] == 4
    assert client.get("/api/trials?config=' OR 1=1 --").json()["total"] == 0
    assert "No trial matches" in client.get("/trials?env=cartpole&width=4").text


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ("sort=loss", "did you mean 'best_loss'?"),
        ("env=pendulun", "did you mean 'pendulum'?"),
        ("width=many", "a whole number of 1"),
        ("size=10000", "Choose one of 25, 50, 100, 200"),
        ("after=[1]", "names no place"),
        ("after=[NaN, 3]", "names no place"),
        ("after=[[], 3]", "names no place"),
        ("status=%00", "zero character"),
    ],
)
def test_a_wrong_request_is_one_sentence(client: TestClient, asked: str, sentence: str) -> None:
    answer = client.get(f"/api/trials?{asked}")
    assert answer.status_code == 400
    assert sentence in answer.json()["error"]
    assert client.get(f"/trials?{asked}").status_code == 400


def test_a_place_of_another_kind_than_the_column_is_harmless(client: TestClient) -> None:
    for place in ('["x", 1]', "[1.5, 1]", "[null, 1]", "[9e99, 1]", f"[{2**62}, {2**62}]"):
        for sort in COLUMNS:
            for way in ("after", "before"):
                answer = client.get("/api/trials", params={"sort": sort, way: place})
                assert answer.status_code in (200, 400), answer.text


def test_only_pages_that_hold_trials_are_linked(client: TestClient) -> None:
    """Also where rows have moved, so that a page backwards is short."""

    def page(**place: str) -> dict[str, Any]:
        given = {"sort": "seed", "order": "asc", "size": "25", **place}
        answer: dict[str, Any] = client.get("/api/trials", params=given).json()
        return answer

    first = page()
    second = page(after=first["next"])
    assert (first["previous"], second["next"]) == (None, None)
    back = page(before=second["previous"])
    assert back["rows"] == first["rows"]
    assert (back["previous"], back["next"]) == (None, first["next"])
    short = page(before=_place(first["rows"][3], "seed"))
    assert short["rows"] == first["rows"][:3]
    assert (short["previous"], short["next"]) == (None, _place(first["rows"][2], "seed"))
