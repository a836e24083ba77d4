"""Pending trials as workers look for them: one contract, every database."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from orchestrate.store import Claim, Failure, Store
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, diverged, result
from tests.orchestrate.store.places import execute

Take = Callable[..., list[Claim]]
Lose = Callable[[Store, list[str]], None]

KILLED = "killed"
MANY = 100
SPECS = [Spec(seed) for seed in range(4)]


@pytest.fixture
def lose(url: str, open_store: Callable[..., Store]) -> Callable[[Store, list[str]], None]:
    """Return a function that lets a launch that holds some trials end without a word."""

    def end_one(store: Store, keys: list[str]) -> None:
        lost = open_store()
        launch = lost.begin_launch(LAUNCH)
        lost.claim(launch, keys)
        lost.close()
        execute(url, f"UPDATE launch SET lease_until = 0 WHERE launch_id = {launch}")
        assert store.recover() == len(keys)

    return end_one


def test_a_configuration_with_its_counts_and_times(store: Store, launch: int, take: Take) -> None:
    store.register(launch, [*SPECS, Spec(0, policy="other")])
    one, two, _ = take(*SPECS[:3])
    store.commit(one, result(), RUN)
    store.commit(two, diverged(2), replace(RUN, wall_seconds=1.5))
    first, second = sorted(store.open_configs(launch), key=lambda config: -config.running)
    assert first.config_key == SPECS[0].config_key
    assert first.config_json == SPECS[0].config_json
    assert (first.pending, first.running) == (1, 1)
    assert (first.mean_seconds, first.max_seconds) == (1.0, 1.5)
    assert (second.pending, second.running, second.mean_seconds) == (1, 0, None)


def test_a_finished_configuration_is_not_open(store: Store, launch: int, take: Take) -> None:
    (claim,) = take(Spec())
    store.commit(claim, result(), RUN)
    assert store.open_configs(launch) == []


def test_pending_trials_of_one_configuration(store: Store, launch: int, take: Take) -> None:
    store.register(launch, [*SPECS, Spec(0, policy="other")])
    take(SPECS[0])
    (config_id,) = {c.config_id for c in store.open_configs(launch) if c.running}
    found = store.open_trials(launch, config_id, MANY, losses=3)
    assert {(one.trial_key, one.seed) for one in found} == {
        (spec.trial_key, spec.seed) for spec in SPECS[1:]
    }
    assert len(store.open_trials(launch, config_id, 2, losses=3)) == 2


def test_a_trial_that_killed_its_process_is_told(store: Store, launch: int, take: Take) -> None:
    take(*SPECS)
    store.release(launch, [SPECS[1].trial_key], KILLED)
    store.release(launch)
    (config,) = store.open_configs(launch)
    crashes = {
        one.seed: one.crashes for one in store.open_trials(launch, config.config_id, MANY, 3)
    }
    assert crashes == {0: 0, 1: 1, 2: 0, 3: 0}


def test_a_trial_whose_launches_were_lost_is_suspect(store: Store, launch: int, lose: Lose) -> None:
    store.register(launch, SPECS)
    lose(store, [SPECS[0].trial_key, SPECS[1].trial_key])
    for _ in range(2):
        lose(store, [SPECS[1].trial_key])
    (config,) = store.open_configs(launch)
    assert {one.seed for one in store.open_trials(launch, config.config_id, MANY, losses=3)} == {
        0,
        2,
        3,
    }
    (suspect,) = store.suspects(launch, losses=3)
    assert (suspect.seed, suspect.lone_losses) == (1, 2)


def test_a_trial_that_is_retried_is_no_suspect(store: Store, launch: int, lose: Lose) -> None:
    keys = store.register(launch, SPECS[:1]).todo
    for _ in range(3):
        lose(store, keys)
    (claim,) = store.claim(launch, keys)
    store.fail(claim, Failure("WorkerLost", "lost", "", "node lost"), RUN)
    store.retry("failed", keys)
    assert store.suspects(launch, losses=3) == []
    (config,) = store.open_configs(launch)
    assert len(store.open_trials(launch, config.config_id, MANY, losses=3)) == 1
