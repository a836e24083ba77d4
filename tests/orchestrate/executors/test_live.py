"""Samples of running trials come to the listener of every executor, and to the database."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from dopt.watching import current_watch
from orchestrate.errors import ExitCode
from orchestrate.executors.base import Executor, Task, TaskDone
from orchestrate.executors.inprocess import InProcessExecutor
from orchestrate.executors.local import LocalExecutor
from orchestrate.executors.lockstep import LockstepExecutor
from orchestrate.records import Sample
from orchestrate.store import Store, StoreUnavailableError
from tests.orchestrate.conftest import Launches
from tests.orchestrate.executors.names import ALL, WORKERS
from tests.orchestrate.standins import quick, specification

PERIOD = 0.02
SECONDS = 1.0

Make = Callable[[float | None], Executor]


def sampling(spec: TrialSpec) -> TrialResult:
    """Show each loss of the result for a moment, as a trial does."""
    result, watch = quick(spec), current_watch()
    for t in range(result.n_steps):
        time.sleep(SECONDS / result.n_steps)
        if watch is not None:
            watch.look(t, result.loss[t : t + 1], result.reachable_loss[t : t + 1])
    return result


@pytest.fixture
def make(executor: str) -> Iterator[Make]:
    started: list[Executor] = []

    def start(live: float | None) -> Executor:
        started.append(new(executor, live))
        started[-1].start()
        return started[-1]

    yield start
    for one in started:
        one.stop()


def new(name: str, live: float | None) -> Executor:
    if name == "inprocess":
        return InProcessExecutor(sampling, live=live)
    if name == "local":
        return LocalExecutor(sampling, WORKERS, live=live)
    ray = importlib.import_module("orchestrate.executors.ray.executor")
    return ray.RayExecutor(sampling, WORKERS, live=live)  # type: ignore[no-any-return]


@pytest.mark.parametrize("executor", ALL, indirect=True)
@pytest.mark.parametrize("live", [PERIOD, None])
def test_the_listener_hears_of_each_trial(make: Make, live: float | None) -> None:
    executor, heard = make(live), list[Sample]()
    executor.listener = heard.append
    specs = {spec.trial_key: spec for spec in map(specification, range(3))}
    executor.submit([Task(key, spec) for key, spec in specs.items()])
    done = []
    while executor.pending:
        done += executor.wait(0.1)
    assert sorted(event.key for event in done if isinstance(event, TaskDone)) == sorted(specs)
    assert {sample.key for sample in heard} == (set() if live is None else set(specs))
    for sample in heard:
        result = quick(specs[sample.key])
        assert (sample.loss, sample.reachable_loss) == (
            result.loss[sample.t],
            result.reachable_loss[sample.t],
        )
    assert len({(sample.key, sample.t) for sample in heard}) == len(heard)


def test_a_batch_tells_of_all_its_trials() -> None:
    executor, heard = LockstepExecutor("cpu", 3, live=1e-9), list[Sample]()
    executor.listener = heard.append
    specs = [specification(seed) for seed in range(3)]
    specs = [replace(one, config=replace(one.config, path="reference")) for one in specs]
    executor.submit([Task(spec.trial_key, spec) for spec in specs])
    executor.start()
    losses = {event.key: event.outcome.loss for event in executor.wait(0.0)}  # type: ignore[union-attr]
    assert len(heard) == 3 * specs[0].system.horizon
    for sample in heard:
        np.testing.assert_array_equal(sample.loss, losses[sample.key][sample.t])


def test_a_running_trial_is_in_the_database(launches: Launches) -> None:
    seen: list[list[tuple[object, ...]]] = []

    def look(spec: TrialSpec) -> TrialResult:
        result = sampling(spec)
        seen.append(
            launches.query("SELECT seed, t, loss FROM live_step JOIN trial USING (trial_id)")
        )
        return result

    assert launches(look, seeds=2, live=PERIOD) == ExitCode.DONE
    for seed, rows in enumerate(seen):
        losses = quick(specification(seed)).loss
        assert rows
        assert all(row == (seed, row[1], losses[row[1]]) for row in rows)
    assert launches.query("SELECT count(*) FROM live_step") == [(0,)]
    assert set(launches.statuses().values()) == {"done"}


def test_without_the_setting_nothing_is_written(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Store, "sample", None)
    assert launches(sampling, seeds=1) == ExitCode.DONE


def test_a_database_that_takes_no_sample_fails_no_trial(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def refuse(_: Store, samples: object) -> None:
        asked.append(samples)
        raise StoreUnavailableError("The database is locked: try again.", transient=True)

    monkeypatch.setattr(Store, "sample", refuse)
    assert launches(sampling, seeds=2, live=PERIOD) == ExitCode.DONE
    assert asked
