"""Ctrl-C: once ends what runs and frees the rest, twice stops at once."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable

import pytest

from orchestrate.runner.signals import Interrupt, undisturbed
from tests.orchestrate.faults.laboratory import Laboratory, alive


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_interrupt_ends_what_runs_and_frees_the_rest(
    laboratory: Laboratory, number: signal.Signals
) -> None:
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        launched.send(number)
        assert launched.end() == 130, launched.errors
    assert "run the same command again to continue" in launched.said
    assert "Traceback" not in launched.errors
    left = laboratory.order.trials - laboratory.count()
    assert left > 0
    assert laboratory.count("status = 'pending'") == left
    laboratory.check_whole()
    laboratory.complete()


def test_two_interrupts_stop_at_once_and_lose_nothing_committed(laboratory: Laboratory) -> None:
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        workers = launched.workers()
        launched.send(signal.SIGINT)
        time.sleep(0.05)
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
    """One of ten of them came in the middle of a transaction, whose lock then stayed."""
    laboratory = laboratory_at(sqlite_url, 4000, seconds=0.005, settings={"patience": 1})
    chance = random.Random(moment)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 20)
        time.sleep(chance.uniform(0, 1))
        launched.send(signal.SIGINT)
        time.sleep(chance.uniform(0.02, 0.15))
        launched.send(signal.SIGINT)
        assert launched.end() == 130, launched.errors
    assert laboratory.count("status = 'running'") == 0


def test_a_signal_that_is_passed_on_counts_once_and_a_second_ctrl_c_counts() -> None:
    signals = (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)
    with Interrupt(signals) as stop:
        for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGTERM):
            os.kill(os.getpid(), number)
        assert stop.stop_requested
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def interrupted(times: int, rest: float = 0.0) -> None:
    """Be interrupted so many times in the middle of a transaction, then go on for some seconds."""
    with undisturbed():
        for _ in range(times):
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(rest)


def test_an_interrupt_waits_for_the_end_of_a_transaction() -> None:
    with Interrupt() as stop:
        interrupted(1)
        assert stop.stop_requested
        start = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            interrupted(1, rest=0.3)
        assert time.monotonic() - start >= 0.3


def test_a_third_interrupt_leaves_a_transaction_that_hangs() -> None:
    start = time.monotonic()
    with Interrupt(), pytest.raises(KeyboardInterrupt):
        interrupted(3, rest=60)
    assert time.monotonic() - start < 30
