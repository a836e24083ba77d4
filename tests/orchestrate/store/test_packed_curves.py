"""Packed curves: the numbers of the steps, also where some of them are missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from orchestrate.store import Claim, Reader, Store, StoreUnavailableError
from orchestrate.store.doctor import examine
from orchestrate.store.schema import STEP_VALUES
from orchestrate.store.upgrade import upgrade
from tests.orchestrate.store.fakes import LAUNCH, RUN, FakeResult, Spec, diverged, result
from tests.orchestrate.store.places import execute

Take = Callable[..., list[Claim]]
SEEDS = range(4)


@pytest.fixture
def finished(store: Store, take: Take) -> list[Spec]:
    """Return done trials of one configuration, and a diverged one."""
    specs = [Spec(seed) for seed in SEEDS]
    for spec, claim in zip(specs, take(*specs), strict=True):
        store.commit(claim, diverged(3) if spec.seed == 2 else result(spec.seed), RUN)
    return specs


def matrices(reader: Reader) -> list[np.ndarray]:
    return [reader.curves(Spec().config_key, name).values for name in STEP_VALUES]


def stored_once(reader: Reader) -> list[np.ndarray]:
    rows = reader.rows(
        f"SELECT {', '.join(STEP_VALUES)} FROM step JOIN trial USING (trial_id) ORDER BY seed, t"
    )
    numbers = np.array([tuple(row) for row in rows], dtype=np.float64)
    return [column.reshape(len(SEEDS), -1) for column in numbers.T]


def test_they_are_the_numbers_of_the_steps(finished: list[Spec], reader: Reader) -> None:
    assert len(reader.rows("SELECT * FROM curve")) == len(finished)
    for packed, steps in zip(matrices(reader), stored_once(reader), strict=True):
        np.testing.assert_array_equal(packed, steps)


def test_no_step_is_read_where_they_are(finished: list[Spec], reader: Reader, url: str) -> None:
    before = matrices(reader)
    execute(url, "DELETE FROM step")
    np.testing.assert_array_equal(matrices(reader), before)
    assert len(before[0]) == len(finished)


@pytest.mark.parametrize(
    "change",
    [
        "DELETE FROM curve",
        "DELETE FROM curve WHERE trial_id = 2",
        "UPDATE curve SET attempt = 7, loss = reachable_loss WHERE trial_id IN (1, 4)",
    ],
)
def test_steps_are_read_where_they_are_not(
    finished: list[Spec], reader: Reader, url: str, change: str
) -> None:
    before = matrices(reader)
    execute(url, change)
    np.testing.assert_array_equal(matrices(reader), before)
    done = upgrade(url)
    assert 0 < done.packed <= len(finished)
    assert upgrade(url).packed == 0
    execute(url, "DELETE FROM step")
    np.testing.assert_array_equal(matrices(reader), before)


@pytest.mark.usefixtures("finished")
def test_a_damaged_array_is_found_and_not_read(reader: Reader, url: str) -> None:
    execute(url, "UPDATE curve SET loss = (SELECT states FROM trajectory WHERE trial_id = 1)")
    with pytest.raises(StoreUnavailableError, match=r"incomplete \(0 steps instead of 28"):
        reader.curves(Spec().config_key)
    (found,) = [one for one in examine(url) if one.severity == "error"]
    assert (found.count, "upgrade" in found.advice) == (len(SEEDS), True)
    execute(url, "DELETE FROM curve")
    upgrade(url)
    assert [one for one in examine(url) if one.severity == "error"] == []


@pytest.mark.usefixtures("finished")
def test_a_trial_that_runs_again_has_its_new_one(store: Store, reader: Reader, take: Take) -> None:
    assert store.retry("diverged") == 1
    assert len(reader.rows("SELECT * FROM curve")) == len(SEEDS) - 1
    (claim,) = take(Spec(2))
    store.commit(claim, result(2), RUN)
    found = reader.curves(Spec().config_key)
    np.testing.assert_array_equal(found.values[2], result(2).loss)
    assert not found.diverged.any()


class Explored(Spec):
    @property
    def config_json(self) -> str:
        return '{"env":{"loss":"prequential"}}'


def test_that_of_an_exploration_grows_with_it(url: str) -> None:
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        last = store.save(launch, Explored(), first_steps(3), RUN)
        store.save(launch, Explored(), first_steps(5), RUN, last)
        store.end_launch(launch, "done")
    execute(url, "DELETE FROM step")
    with Reader.open(url) as reader:
        found = reader.curves(Explored().config_key).values
    np.testing.assert_array_equal(found, [result().loss[:5]])


def first_steps(n: int) -> FakeResult:
    """Return a result that has come to its first n steps."""
    whole = result()
    cut = {name: getattr(whole, name)[:n] for name in (*STEP_VALUES, "inputs")}
    final = float(whole.loss[n - 1])
    return replace(whole, **cut, states=whole.states[: n + 1], n_steps=n, final_loss=final)
