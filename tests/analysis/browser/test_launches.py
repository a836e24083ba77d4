"""The head of the grid: every command with its outcome, and every kind of failure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from starlette.testclient import TestClient

from orchestrate.store import LaunchRecord, Store
from tests.analysis.browser import grids
from tests.analysis.synthetic import make_grid


def test_launches_and_failures_are_those_of_the_database(client: TestClient) -> None:
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
