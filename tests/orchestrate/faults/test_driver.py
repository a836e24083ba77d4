"""Kill -9 of the driver: at chosen moments and at many random ones."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from itertools import pairwise

import pytest

from tests.orchestrate.faults.laboratory import Laboratory, alive
from tests.waiting import until

KILLS = 30
LONGEST_SECONDS = 0.4
TRIALS = 400


@pytest.mark.parametrize(("pause", "done"), [("claim", 0), ("commit", 2)])
def test_death_at_a_chosen_moment(laboratory: Laboratory, pause: str, done: int) -> None:
    with laboratory.launched(pause=pause, executor="inprocess") as launched:
        launched.until(lambda: launched.paused)
        launched.kill()
    assert laboratory.count() == done
    assert laboratory.count("true") == laboratory.order.trials
    laboratory.check_whole()
    laboratory.end_lease(launched)
    laboratory.complete()


def test_death_in_mid_run_leaves_whole_trials_and_no_process(laboratory: Laboratory) -> None:
    die_in_mid_run(laboratory)


@pytest.mark.xdist_group("ray")
def test_death_of_a_driver_that_runs_ray(
    sqlite_url: str, laboratory_at: Callable[..., Laboratory]
) -> None:
    die_in_mid_run(laboratory_at(sqlite_url, executor="ray"))


def die_in_mid_run(laboratory: Laboratory) -> None:
    laboratory.gate.let(20)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        workers = launched.workers()
        assert len(workers) >= 2
        launched.kill()
    until(lambda: not any(map(alive, workers)))
    before = laboratory.count()
    assert 5 <= before < laboratory.order.trials
    laboratory.check_whole()
    laboratory.end_lease(launched)
    said = laboratory.complete(executor="inprocess")
    assert f"{before} of {laboratory.order.trials} already done" in said


def test_death_at_many_random_moments(url: str, laboratory_at: Callable[..., Laboratory]) -> None:
    laboratory = laboratory_at(url, TRIALS, seconds=0.003, executor="inprocess")
    moments, done = random.Random(0), [0]
    while len(done) <= KILLS and done[-1] < TRIALS:
        laboratory.gate.let(30)
        with laboratory.launched() as launched:
            if len(done) % 2:  # at work in any case, and before anything in the others
                launched.until(lambda: laboratory.count() > done[-1])
            time.sleep(moments.uniform(0.0, LONGEST_SECONDS))
            launched.kill()
        laboratory.end_lease(launched)
        done.append(laboratory.count())
    assert done == sorted(done), "what was committed is lost"
    assert sum(before < after for before, after in pairwise(done)) > 3, "none was killed at work"
    laboratory.check_whole()
    laboratory.complete()
