"""Trials of another database come in whole, once, and never over a result."""

from __future__ import annotations

import resource
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import create_engine, text

from orchestrate.store import Claim, Failure, NoDatabaseError, Reader, Store, StoreError
from orchestrate.store import merge as source
from orchestrate.store.merge import Merged, merge
from tests.orchestrate.store.everything import everything
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, diverged, result
from tests.orchestrate.store.processes import hear, kill, merge_and_tell, running

KEY = Spec().config_key
FAILURE = Failure("ValueError", "no", "Traceback: no")


def fill(url: str, *specs: Spec, offset: int = 0) -> None:
    """Run trials: of four, one diverges and one fails, and the last one of all stays pending."""
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        claims = store.claim(launch, store.register(launch, specs).todo)
        for spec, claim in zip(specs[:-1], claims, strict=False):
            number = spec.seed + offset
            if spec.seed % 4 == 1:
                store.commit(claim, diverged(3, seed=number), RUN)
            elif spec.seed % 4 == 2:
                store.fail(claim, FAILURE, RUN)
            else:
                store.commit(claim, result(number, spec.horizon), RUN)
        store.end_launch(launch, "failed", exit_code=1)


def seeds(*numbers: int, policy: str = "random") -> list[Spec]:
    return [Spec(seed, policy=policy) for seed in numbers]


def test_an_empty_database_becomes_a_copy(url: str, other: str) -> None:
    fill(other, *seeds(*range(9)), Spec(99))
    found = merge(url, other)
    assert found == Merged(added={"done": 5, "diverged": 2, "failed": 2}, launches=1)
    mine, theirs = everything(url), everything(other)
    theirs[0] = [row for row in theirs[0] if "'pending'" not in row]
    theirs[3] = [row for row in theirs[3] if "'released'" not in row]
    assert mine == theirs


def test_again_changes_nothing(url: str, other: str) -> None:
    fill(url, *seeds(50, 51, 52), Spec(99))
    fill(other, *seeds(*range(9)), Spec(99))
    merge(url, other)
    before = everything(url)
    again = merge(url, other)
    assert (again.identical, again.kept, again.changed) == (7, 2, False)
    assert everything(url) == before


@pytest.mark.parametrize("steps", [1, 25])
def test_pages_of_few_steps_bring_the_same(
    url: str, other: str, monkeypatch: pytest.MonkeyPatch, steps: int
) -> None:
    monkeypatch.setattr(source, "PAGE_STEPS", steps)
    fill(other, *seeds(*range(9)), Spec(99))
    assert merge(url, other).added == {"done": 5, "diverged": 2, "failed": 2}
    mine, theirs = everything(url), everything(other)
    theirs[0] = [row for row in theirs[0] if "'pending'" not in row]
    theirs[3] = [row for row in theirs[3] if "'released'" not in row]
    assert mine == theirs


def test_numbers_are_given_anew(url: str, other: str) -> None:
    fill(url, *seeds(10, 11, 12), Spec(99))
    fill(other, *seeds(2, 1, 0, policy="uniform"), *seeds(0, 1), Spec(99))
    merge(url, other)
    with Reader.open(url) as reader:
        assert reader.curves(KEY).seeds.tolist() == [0, 1, 11, 12]
        uniform = Spec(policy="uniform").config_key
        np.testing.assert_array_equal(reader.curves(uniform).values[0], result(0).loss)
        np.testing.assert_array_equal(reader.trajectory(KEY, 0).states, result(0).states)
        failures = reader.query("SELECT seed, policy FROM v_failures ORDER BY seed")
        assert [tuple(row) for row in failures] == [(2, "uniform"), (10, "random")]
    with Store.open(url) as store:
        fresh = store.begin_launch(LAUNCH)
        assert store.register(fresh, [Spec(77)]).todo == [Spec(77).trial_key]


def test_equal_numbers_are_one_trial_and_others_a_conflict(url: str, other: str) -> None:
    fill(url, *seeds(0, 3, 4, 1), Spec(99))
    fill(other, *seeds(0, 1, 5), Spec(99))
    fill(other, *seeds(3), Spec(99), offset=1000)
    before = everything(url)[1]
    found = merge(url, other)
    assert found.added == {"diverged": 1}
    assert found.identical == 2
    assert [(one.trial_key, one.seed) for one in found.conflicts] == [(Spec(3).trial_key, 3)]
    assert set(before) <= set(everything(url)[1])
    with Reader.open(url) as reader:
        np.testing.assert_array_equal(reader.curves(KEY).values[2], result(3).loss)


def test_times_of_equal_trials_may_differ(url: str, other: str) -> None:
    fill(url, *seeds(0), Spec(99))
    with Store.open(other) as store:
        launch = store.begin_launch(LAUNCH)
        (claim,) = store.claim(launch, store.register(launch, seeds(0)).todo)
        store.commit(claim, replace(result(0), plan_us=np.ones(7)), replace(RUN, node="there"))
    assert merge(url, other).identical == 1


@pytest.mark.parametrize("name", ["states", "inputs", "parameters", "loss", "reachable_loss"])
def test_any_other_number_is_a_conflict(tmp_path: Path, name: str) -> None:
    url, other = (f"sqlite:///{tmp_path}/{i}.db" for i in range(2))
    fill(url, *seeds(0), Spec(99))
    changed = getattr(result(0), name).copy()
    changed.flat[-1] = np.nextafter(changed.flat[-1], 2)
    with Store.open(other) as store:
        launch = store.begin_launch(LAUNCH)
        (claim,) = store.claim(launch, store.register(launch, seeds(0)).todo)
        store.commit(claim, replace(result(0), **{name: changed}), RUN)
    assert len(merge(url, other).conflicts) == 1


def test_a_result_takes_the_place_of_a_failure_and_not_the_other_way(url: str, other: str) -> None:
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        failed, done, waits = store.claim(launch, store.register(launch, seeds(0, 4, 8)).todo)
        store.fail(failed, FAILURE, RUN)
        store.commit(done, result(4), RUN)
        store.release(launch, [waits.trial_key])
        store.end_launch(launch, "failed")
    with Store.open(other) as store:
        launch = store.begin_launch(LAUNCH)
        claims = store.claim(launch, store.register(launch, seeds(0, 4, 8)).todo)
        store.commit(claims[0], result(0), RUN)
        for claim in claims[1:]:
            store.fail(claim, FAILURE, RUN)
    found = merge(url, other)
    assert found.added == {"done": 1, "failed": 1}
    assert found.kept == 1
    with Reader.open(url) as reader:
        rows = reader.trials(KEY)
        assert [row.status for row in rows] == ["done", "done", "failed"]
        assert [row.error_type for row in rows] == [None, None, "ValueError"]
        attempts = reader.query(
            "SELECT seed, a.attempt, outcome FROM attempt a JOIN trial r ON r.trial_id = a.trial_id"
            " ORDER BY seed, a.attempt"
        )
        assert [tuple(row) for row in attempts] == [
            (0, 1, "failed"), (0, 2, "done"), (4, 1, "done"), (8, 1, "released"), (8, 2, "failed")
        ]  # fmt: skip
        assert [row.attempt for row in rows] == [2, 1, 2]


@pytest.mark.parametrize(("seed", "status"), [(1, "diverged"), (2, "failed")])
def test_what_is_to_run_again_does_not_come_back(
    url: str, other: str, seed: int, status: str
) -> None:
    fill(other, *seeds(seed), Spec(99))
    merge(url, other)
    with Store.open(url) as store:
        assert store.retry(status) == 1
    assert merge(url, other).kept == 1
    with Reader.open(url) as reader:
        assert [row.status for row in reader.trials(KEY)] == ["pending"]


def test_what_a_launch_runs_here_is_left_to_it(
    store: Store, url: str, other: str, take: Callable[..., list[Claim]]
) -> None:
    (claim,) = take(Spec(0))
    fill(other, *seeds(0, 3), Spec(99))
    found = merge(url, other)
    assert (found.running, found.added) == (1, {"done": 1})
    assert store.commit(claim, result(0), RUN)
    assert merge(url, other).identical == 2


def test_what_runs_there_does_not_run_here(url: str, other: str) -> None:
    with Store.open(other) as store:
        launch = store.begin_launch(LAUNCH)
        one, two = store.claim(launch, store.register(launch, seeds(0, 3)).todo)
        store.commit(one, result(0), RUN)
        assert merge(url, other).added == {"done": 1}
        assert _launches(url) == [("lost", None, None)]
        store.commit(two, result(3), RUN)
        store.end_launch(launch, "done", exit_code=0)
    found = merge(url, other)
    assert (found.added, found.launches) == ({"done": 1}, 0)
    assert _launches(url) == _launches(other)
    assert everything(url) == everything(other)


def _launches(url: str) -> list[tuple[object, ...]]:
    with Reader.open(url) as reader:
        return [tuple(row) for row in reader.query("SELECT state, ended, exit_code FROM launch")]


@pytest.mark.parametrize(
    "damage", ["DELETE FROM step WHERE t = 3", "DELETE FROM trajectory", "DELETE FROM step"]
)
def test_only_whole_trials_come(url: str, other: str, damage: str) -> None:
    fill(other, *seeds(0), Spec(99))
    engine = create_engine(other)
    with engine.begin() as connection:
        connection.execute(text(damage))
    engine.dispose()
    found = merge(url, other)
    assert [one.trial_key for one in found.incomplete] == [Spec(0).trial_key]
    with Reader.open(url) as reader:
        assert reader.query("SELECT * FROM trial") == []


def test_a_merge_that_was_killed_is_completed(
    url: str, other: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "PAGE", 3)
    fill(other, *seeds(*range(12)), Spec(99))
    with running(merge_and_tell, url, other, 7) as (process, pipe):
        assert hear(pipe) == "in the middle"
        kill(process)
    with Reader.open(url) as reader:
        assert len(reader.query("SELECT * FROM trial")) == 6
    found = merge(url, other)
    assert sum(found.added.values()) == 6
    theirs = everything(other)
    theirs[0] = [row for row in theirs[0] if "'pending'" not in row]
    theirs[3] = [row for row in theirs[3] if "'released'" not in row]
    assert everything(url) == theirs


def test_memory_does_not_grow_with_the_rows(tmp_path: Path) -> None:
    url, other = (f"sqlite:///{tmp_path}/{i}.db" for i in range(2))
    horizon, count = 2_000, 100
    with Store.open(other) as store:
        launch = store.begin_launch(LAUNCH)
        specs = [Spec(seed, horizon=horizon) for seed in range(count)]
        sent = result(0, horizon)
        for claim in store.claim(launch, store.register(launch, specs).todo):
            store.commit(claim, sent, RUN)
    with running(_merge_and_measure, url, other) as (_, pipe):
        added, kilobytes = hear(pipe)
    assert added == {"done": count}
    # 200,000 rows of five numbers are 24 MB as Python objects in a list of tuples.
    assert kilobytes < 15_000


def _merge_and_measure(pipe, url: str, other: str) -> None:  # type: ignore[no-untyped-def]
    Store.open(url).close()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = merge(url, other)
    pipe.send((found.added, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))


def test_refuses_itself_and_nothing(url: str, other: str, store: Store) -> None:  # noqa: ARG001
    with pytest.raises(StoreError, match="Both databases"):
        merge(url, url)
    if other.startswith("sqlite"):
        with pytest.raises(NoDatabaseError):
            merge(url, other)
