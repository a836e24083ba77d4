"""Leases on the clock of a server, and a transaction that comes in the middle of another one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection as Pipe
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event

from dopt.kernel.run import KernelTrial
from dopt.run import run_trial
from orchestrate.executors.base import Task, run_task
from orchestrate.executors.limits import Limits
from orchestrate.records import Failure
from orchestrate.runner.saving import kept_alive
from orchestrate.store import Reader, Store
from orchestrate.store.maintenance import examine
from orchestrate.store.merge import Source, merge
from orchestrate.store.store import LEASE_SECONDS
from tests.dopt.trials import trial
from tests.orchestrate.losses import lose
from tests.orchestrate.store.databases import execute
from tests.orchestrate.store.fakes import FAILURE, LAUNCH, RUN, Spec, begin, diverged, result
from tests.orchestrate.store.processes import hear, running
from tests.waiting import PATIENCE_SECONDS, until

LEASE = 4.0


@pytest.fixture
def many_beats(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let ten heartbeats come in a second, and a lease last as long as ever."""
    monkeypatch.setattr("orchestrate.runner.saving.HEARTBEATS_PER_LEASE", 600)


def wait_for_renewals(url: str, count: int = 3) -> None:
    """Wait until the lease of the only launch was renewed so many times."""
    for _ in range(count):
        before = lease_of(url)
        until(lambda before=before: lease_of(url) > before)  # type: ignore[misc]


def lease_of(url: str) -> float:
    [(end,)] = execute(url, "SELECT lease_until FROM launch")
    return float(str(end))


@pytest.fixture
def url(postgresql_url: str) -> str:
    """On SQLite the kernel knows who lives."""
    return postgresql_url


@pytest.mark.usefixtures("many_beats")
def test_the_lease_is_renewed_while_the_main_thread_does_nothing(
    url: str, open_store: Callable[..., Store], monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, others = open_store(), open_store()
    launch, (claim,) = begin(mine, Spec(0))
    lose(monkeypatch, ["question", "answer"], ["heartbeat"])
    with kept_alive(mine, launch, LEASE_SECONDS):
        wait_for_renewals(url)
        assert others.recover() == 0
    assert mine.commit(claim, result(), RUN)


def test_without_it_the_trials_are_taken(open_store: Callable[..., Store]) -> None:
    mine, others = open_store(LEASE), open_store(LEASE)
    launch, (claim,) = begin(mine, Spec(0))
    with kept_alive(mine, launch, LEASE):
        assert [thread.name for thread in threading.enumerate()].count("heartbeat") == 1
    assert "heartbeat" not in [thread.name for thread in threading.enumerate()]
    until(others.recover, lambda: "the lease does not end")
    assert not mine.commit(claim, result(), RUN)


def take_what_is_free(pipe: Pipe, url: str) -> None:
    """Recover again and again until told to stop; then say how many trials were free."""
    freed = 0
    with Store.open(url) as store:
        pipe.send("watching")
        while not pipe.poll(0.2):
            freed += store.recover()
    pipe.send(freed)


@pytest.mark.usefixtures("many_beats")
def test_a_trial_in_compiled_code_does_not_silence_it(
    url: str, open_store: Callable[..., Store], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would hold the interpreter's lock for minutes if it did not give it away.

    The trial is interrupted after some heartbeats in compiled code, and would last long without.
    """
    run_trial(trial("quadrotor", "d_optimal", env={"horizon": 3}))  # to load what is compiled
    spec = trial("quadrotor", "d_optimal", env={"horizon": 5000}, model={"width": 32})
    store = open_store()
    launch = store.begin_launch(LAUNCH)
    heartbeat, advance = store.heartbeat, KernelTrial.advance
    compiled, beats, main = threading.Event(), list[int](), threading.get_ident()

    def compiled_advance(kernel: KernelTrial, last: int) -> None:
        compiled.set()
        advance(kernel, last)
        compiled.clear()

    def counted(launch: int) -> None:
        heartbeat(launch)
        if compiled.is_set():
            beats.append(launch)
            if len(beats) == 3:
                signal.pthread_kill(main, signal.SIGALRM)

    monkeypatch.setattr("dopt.kernel.run.FIRST_STEPS", 10)
    monkeypatch.setattr(KernelTrial, "advance", compiled_advance)
    monkeypatch.setattr(store, "heartbeat", counted)
    with kept_alive(store, launch, LEASE_SECONDS), running(take_what_is_free, url) as (_, pipe):
        [claim] = store.claim(launch, store.register(launch, [Spec(0)]).todo)
        assert hear(pipe) == "watching"
        ran = run_task(run_trial, Task(spec.trial_key, spec), Limits(seconds=PATIENCE_SECONDS))
        pipe.send("stop")
        assert hear(pipe) == 0
    assert isinstance(ran.outcome, Failure)
    assert "in advance" in ran.outcome.traceback
    assert store.commit(claim, result(), RUN)


@pytest.fixture
def interrupt() -> Iterator[Callable[..., list[Any]]]:
    """Return what calls a function once, after a store's first statement with such a beginning."""
    listeners = []

    def once(store: Store, beginning: str, action: Callable[[], Any]) -> list[Any]:
        done: list[Any] = []

        def listen(_connection: object, _cursor: object, statement: str, *_: object) -> None:
            if statement.startswith(beginning) and not done:
                done.append(None)
                done[0] = action()

        event.listen(store._backend.engine, "after_cursor_execute", listen)
        listeners.append((store._backend.engine, listen))
        return done

    yield once
    for engine, listen in listeners:
        event.remove(engine, "after_cursor_execute", listen)


@pytest.mark.parametrize("beginning", ["DELETE FROM step", "UPDATE trial"])
def test_an_outcome_that_comes_during_a_retry_keeps_its_rows(
    open_store: Callable[..., Store], url: str, interrupt: Callable[..., list[Any]], beginning: str
) -> None:
    one, two = open_store(), open_store()
    launch, other = one.begin_launch(LAUNCH), two.begin_launch(LAUNCH)
    keys = one.register(launch, [Spec(0), Spec(1)]).todo
    before, during = one.claim(launch, keys)
    one.commit(before, diverged(3, 0), RUN)
    committed = interrupt(two, beginning, lambda: one.commit(during, diverged(2, 1), RUN))
    assert two.retry("diverged", keys) == 1
    assert committed == [True]
    with Reader.open(url) as reader:
        statuses = {row.seed: row.status for row in reader.trials(Spec().config_key)}
    assert statuses == {0: "pending", 1: "diverged"}
    assert not [found for found in examine(url) if "steps" in found.sentence]
    (again,) = two.claim(other, keys)
    assert two.commit(again, diverged(3, 0), RUN)


def test_a_traceback_is_not_pruned_while_a_trial_comes_to_refer_to_it(
    open_store: Callable[..., Store], interrupt: Callable[..., list[Any]]
) -> None:
    one, two = open_store(), open_store()
    launch = one.begin_launch(LAUNCH)
    keys = one.register(launch, [Spec(0)]).todo
    one.fail(one.claim(launch, keys)[0], FAILURE, RUN)
    one.end_launch(launch, "done")
    later = one.begin_launch(LAUNCH)
    (claim,) = one.claim(later, one.register(later, [Spec(1)]).todo)
    pruned = interrupt(one, "INSERT INTO error", lambda: two.prune(keys))
    assert one.fail(claim, FAILURE, RUN)
    assert pruned == [1]


def test_a_merge_uses_the_traceback_that_a_launch_has_inserted_meanwhile(
    store: Store, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = f"sqlite:///{tmp_path}/other.db"
    with Store.open(other) as filled:
        launch, (failed,) = begin(filled, Spec(0))
        filled.fail(failed, FAILURE, RUN)
        filled.end_launch(launch, "failed")
    launch, (claim,) = begin(store, Spec(1))
    read = Source.error

    def fail_meanwhile(source: Source, digest: str) -> dict[str, Any]:
        assert store.fail(claim, FAILURE, RUN)
        return read(source, digest)

    monkeypatch.setattr(Source, "error", fail_meanwhile)
    assert merge(url, other).added == {"failed": 1}
    with Reader.open(url) as reader:
        assert len(reader.rows("SELECT * FROM error")) == 1
