"""Ctrl-C: once ends what runs and frees the rest, twice stops at once."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from orchestrate.runner import progress
from orchestrate.runner.progress import FINISHING, Interrupt, undisturbed
from tests.orchestrate.faults.laboratory import Laboratory, Launched, alive


def interrupt(launched: Launched, number: signal.Signals = signal.SIGINT) -> None:
    """Send a signal, and wait until the launch has heard it: two at once would be one."""
    launched.send(number)
    launched.until(lambda: FINISHING in launched.errors)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_interrupt_ends_what_runs_and_frees_the_rest(
    laboratory: Laboratory, number: signal.Signals
) -> None:
    laboratory.gate.let(20)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        interrupt(launched, number)
        laboratory.gate.open()
        assert launched.end() == 130, launched.errors
    assert "run the same command again to continue" in launched.said
    assert "Traceback" not in launched.errors
    left = laboratory.order.trials - laboratory.count()
    assert left > 0
    assert laboratory.count("status = 'pending'") == left
    laboratory.check_whole()
    laboratory.complete()


def test_two_interrupts_stop_at_once_and_lose_nothing_committed(laboratory: Laboratory) -> None:
    laboratory.gate.let(20)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        workers = launched.workers()
        assert len(workers) == 2
        interrupt(launched)
        launched.send(signal.SIGINT)
        assert launched.end() == 130, launched.errors
    assert "Traceback" not in launched.errors
    assert not any(map(alive, workers))
    assert laboratory.count() >= 5
    assert laboratory.count("status = 'running'") == 0
    laboratory.check_whole()
    laboratory.complete()


@pytest.mark.parametrize("moment", range(12))
def test_two_interrupts_at_any_moment_leave_no_lock(
    sqlite_url: str, laboratory_at: Callable[..., Laboratory], moment: int
) -> None:
    """One of ten of them came in the middle of a transaction, whose lock then stayed.

    One trial never ends: without the second interrupt the launch does not either.
    """
    laboratory = laboratory_at(sqlite_url, 4000, seconds=0.005, trouble="hang")
    chance = random.Random(moment)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 20)
        time.sleep(chance.uniform(0, 1))
        interrupt(launched)
        time.sleep(chance.uniform(0.02, 0.15))
        launched.send(signal.SIGINT)
        assert launched.end() == 130, launched.errors
    assert laboratory.count("status = 'running'") == 0


def test_a_signal_that_is_passed_on_counts_once_and_a_second_ctrl_c_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: 100.0))
    with Interrupt((signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)) as stop:
        for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGTERM):
            os.kill(os.getpid(), number)
        assert stop.stop_requested
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def interrupted(times: int, went_on: list[int], rest: float = 0.0) -> None:
    """Be interrupted so many times in the middle of a transaction, and tell when it went on."""
    with undisturbed():
        for _ in range(times):
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(rest)
        went_on.append(times)


def test_an_interrupt_waits_for_the_end_of_a_transaction() -> None:
    went_on: list[int] = []
    with Interrupt() as stop:
        interrupted(1, went_on)
        assert stop.stop_requested
        with pytest.raises(KeyboardInterrupt):
            interrupted(1, went_on, rest=0.3)
    assert went_on == [1, 1]


def test_a_third_interrupt_leaves_a_transaction_that_hangs() -> None:
    went_on: list[int] = []
    with Interrupt(), pytest.raises(KeyboardInterrupt):
        interrupted(3, went_on, rest=60.0)
    assert went_on == []
