"""The list of trials: every order, its pages and its filters, on both databases."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from starlette.testclient import TestClient

from analysis.serve import pages


@pytest.mark.parametrize("order", ["asc", "desc"])
@pytest.mark.parametrize("sort", pages.COLUMNS)
def test_pages_hold_every_trial_once_in_order(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, sort: str, order: str
) -> None:
    monkeypatch.setattr(pages, "PAGE_ROWS", 20)
    found = [
        client.get(f"/api/trials?sort={sort}&order={order}&page={page}").json()
        for page in (1, 2, 3, 4)
    ]
    assert [len(one["rows"]) for one in found] == [20, 20, 8, 0]
    assert [(one["total"], one["last"]) for one in found] == [(48, 3)] * 4
    rows = [row for one in found for row in one["rows"]]
    assert len({row["trial_key"] for row in rows}) == 48
    known = [row[sort] for row in rows if row[sort] is not None]
    assert known == sorted(known, reverse=order == "desc")
    assert all(row[sort] is None for row in rows[len(known) :])
    first, middle, last, beyond = (client.get(f"/trials?page={n}").text for n in (1, 2, 3, 4))
    assert ['rel="prev"' in page for page in (first, middle, last, beyond)] == [0, 1, 1, 1]
    assert ['rel="next"' in page for page in (first, middle, last, beyond)] == [1, 1, 0, 0]
    assert "The list has 3 pages" in beyond


def test_labels_tell_configurations_apart(
    visit: Callable[..., TestClient], variants_grid: str
) -> None:
    found = visit(variants_grid).get("/api/trials?env=pendulum&policy=d_optimal&seed=0").json()
    labels = {row["label"] for row in found["rows"]}
    assert any("adam_replay" in label for label in labels)
    assert any("γ=3" in label for label in labels)


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
