"""A launch keeps its trials for as long as it lives, however long one trial holds it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection as Pipe

import pytest

from dopt.run import run_trial
from orchestrate.executors.base import Task
from orchestrate.executors.limits import Limits
from orchestrate.executors.task import run_task
from orchestrate.runner.heartbeat import Heartbeat
from orchestrate.store import Store
from tests.dopt.trials import trial
from tests.orchestrate.losses import lose
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result
from tests.orchestrate.store.processes import hear, running

LEASE = 2.0
LONG_LEASE = 3.0


@pytest.fixture
def url(postgresql_url: str) -> str:
    """On SQLite the kernel knows who lives."""
    return postgresql_url


def test_the_lease_is_renewed_while_the_main_thread_does_nothing(
    open_store: Callable[..., Store], monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, others = open_store(LEASE), open_store(LEASE)
    launch = mine.begin_launch(LAUNCH)
    [claim] = mine.claim(launch, mine.register(launch, [Spec(0)]).todo)
    lose(monkeypatch, ["question", "answer"], ["heartbeat"])
    with Heartbeat(mine, launch, LEASE):
        for _ in range(6):
            time.sleep(LEASE / 4)
            assert others.recover() == 0
    assert mine.commit(claim, result(), RUN)


def test_without_it_the_trials_are_taken(open_store: Callable[..., Store]) -> None:
    mine, others = open_store(LEASE), open_store(LEASE)
    launch = mine.begin_launch(LAUNCH)
    [claim] = mine.claim(launch, mine.register(launch, [Spec(0)]).todo)
    with Heartbeat(mine, launch, LEASE):
        assert [thread.name for thread in threading.enumerate()].count("heartbeat") == 1
    assert "heartbeat" not in [thread.name for thread in threading.enumerate()]
    end = time.monotonic() + 60.0
    while not others.recover():
        assert time.monotonic() < end, "the lease does not end"
        time.sleep(0.1)
    assert not mine.commit(claim, result(), RUN)


def take_what_is_free(pipe: Pipe, url: str) -> None:
    """Recover again and again until told to stop; then say how many trials were free."""
    freed = 0
    with Store.open(url, lease_seconds=LONG_LEASE) as store:
        pipe.send("watching")
        while not pipe.poll(0.2):
            freed += store.recover()
    pipe.send(freed)


def test_a_trial_in_compiled_code_does_not_silence_it(
    url: str, open_store: Callable[..., Store]
) -> None:
    """It would hold the interpreter's lock for minutes if it did not give it away."""
    run_trial(trial("quadrotor", "d_optimal", env={"horizon": 3}))  # to load what is compiled
    spec = trial("quadrotor", "d_optimal", env={"horizon": 5000}, model={"width": 64})
    limits = Limits(seconds=1.5 * LONG_LEASE)
    store = open_store(LONG_LEASE)
    launch = store.begin_launch(LAUNCH)
    with Heartbeat(store, launch, LONG_LEASE), running(take_what_is_free, url) as (_, pipe):
        [claim] = store.claim(launch, store.register(launch, [Spec(0)]).todo)
        assert hear(pipe) == "watching"
        ran = run_task(run_trial, Task(spec.trial_key, spec), limits)
        pipe.send("stop")
        assert hear(pipe) == 0
    assert ran.run.wall_seconds >= 1.5 * LONG_LEASE
    assert store.commit(claim, result(), RUN)
