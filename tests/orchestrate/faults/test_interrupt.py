"""Ctrl-C: once ends what runs and frees the rest, twice stops at once."""

from __future__ import annotations

import signal
import time

import pytest

from tests.orchestrate.faults.laboratory import Laboratory, alive


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_interrupt_ends_what_runs_and_frees_the_rest(
    laboratory: Laboratory, number: signal.Signals
) -> None:
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        launched.send(number)
        assert launched.end() == 130, launched.errors
    assert "the same command goes on from here" in launched.said
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
