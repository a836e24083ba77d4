"""Samples of running trials: written by who holds the claim, gone when the trial stops running."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from orchestrate.records import Sample
from orchestrate.store import Claim, Failure, Reader, Store
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result

Take = Callable[..., list[Claim]]
ALL = "SELECT t, loss, reachable_loss FROM live_step ORDER BY trial_id, t"
FAILURE = Failure("ZeroDivisionError", "no", "here")


def sample(claim: Claim, t: int) -> tuple[Claim, Sample]:
    return claim, Sample(claim.trial_key, t, 1.5 - t, float("nan"))


def test_they_are_no_result(store: Store, take: Take, reader: Reader) -> None:
    (claim,) = take(Spec())
    store.sample([sample(claim, 2), sample(claim, 5)])
    store.sample([sample(claim, 5), sample(claim, 6)])
    store.sample([])
    assert reader.query(ALL) == [(2, -0.5, None), (5, -3.5, None), (6, -4.5, None)]
    assert reader.curves(Spec().config_key, "loss").values.size == 0
    assert reader.query("SELECT * FROM step") == []
    assert reader.query("SELECT * FROM v_curve") == []
    (row,) = reader.trials(Spec().config_key)
    assert (row.status, row.n_steps, row.final_loss) == ("running", None, None)


@pytest.mark.parametrize("end", ["commit", "fail", "release", "end_launch"])
def test_the_end_of_an_attempt_deletes_its_own(
    store: Store, launch: int, take: Take, reader: Reader, end: str
) -> None:
    other_launch = store.begin_launch(LAUNCH)
    claim, other = take(Spec(0), Spec(1))
    store.release(launch, [other.trial_key])
    (other,) = store.claim(other_launch, [other.trial_key])
    store.sample([sample(claim, 1), sample(other, 4)])
    if end == "commit":
        assert store.commit(claim, result(), RUN)
    elif end == "fail":
        assert store.fail(claim, FAILURE, RUN)
    elif end == "release":
        assert store.release(launch) == 1
    else:
        store.end_launch(launch, "interrupted")
    assert [row.t for row in reader.query(ALL)] == [4]


def test_the_trials_of_a_dead_launch_lose_theirs(
    open_store: Callable[..., Store], url: str
) -> None:
    dying = open_store(0.1)
    launch = dying.begin_launch(LAUNCH)
    (claim,) = dying.claim(launch, dying.register(launch, [Spec()]).todo)
    dying.sample([sample(claim, 1)])
    dying.close()
    store = open_store()
    with Reader.open(url) as reader:
        assert len(reader.query(ALL)) == 1
        while not store.recover():
            pass
        assert reader.query(ALL) == []


def test_a_lost_claim_writes_none(store: Store, launch: int, take: Take, reader: Reader) -> None:
    (lost,) = take(Spec())
    store.release(launch)
    store.sample([sample(lost, 1)])
    assert reader.query(ALL) == []
    (mine,) = store.claim(store.begin_launch(LAUNCH), [lost.trial_key])
    store.sample([sample(lost, 1), sample(mine, 2)])
    assert [row.t for row in reader.query(ALL)] == [2]
    store.commit(mine, result(), RUN)
    store.sample([sample(mine, 3)])
    assert reader.query(ALL) == []


def test_a_trial_that_is_being_freed_is_left_alone(
    open_store: Callable[..., Store], url: str
) -> None:
    """Whoever frees a trial deletes its samples, and may not find one that comes meanwhile."""
    if url.startswith("sqlite"):
        pytest.skip("SQLite has one writer at a time")
    store, other = open_store(), open_store()
    launch = store.begin_launch(LAUNCH)
    (claim,) = store.claim(launch, store.register(launch, [Spec()]).todo)
    with store._backend.transaction() as connection:
        connection.exec_driver_sql("UPDATE trial SET status = 'pending', owner = NULL")
        other.sample([sample(claim, 1)])
        connection.exec_driver_sql("DELETE FROM live_step")
    with Reader.open(url) as reader:
        assert reader.query(ALL) == []


def test_a_bundle_holds_none(store: Store, take: Take, url: str, tmp_path: Path) -> None:
    from orchestrate.__main__ import main

    (claim, _) = take(Spec(0), Spec(1))
    store.sample([sample(claim, 1)])
    assert main(["export", "bundle", str(tmp_path / "bundle"), "--db", url]) == 0
    assert not (tmp_path / "bundle" / "live_step.parquet").exists()
    with Reader.open(f"bundle:///{tmp_path}/bundle") as reader:
        assert reader.query(ALL) == []
