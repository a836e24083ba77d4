"""Kill -9 of a worker: its chunk runs again, and nobody else notices."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

from tests.orchestrate.faults.laboratory import Laboratory

AHEAD = 24
"""More trials than two workers hold: once so many are stored, what a third one held has run."""


def test_killed_workers_cost_nothing(url: str, laboratory_at: Callable[..., Laboratory]) -> None:
    """No trial is there twice when its worker dies alone, which would make a failed one of it."""
    laboratory = laboratory_at(url, trials=120)
    gate = laboratory.gate
    with laboratory.launched() as launched:
        for in_the_flow in (False, True, True):
            gate.let(5)
            launched.until(gate.waiting)
            victim = gate.waiting()[0]
            if in_the_flow:
                gate.let(5)
            os.kill(victim, signal.SIGKILL)
            stored = laboratory.count()
            gate.let(AHEAD)
            launched.until(lambda stored=stored: laboratory.count() >= stored + AHEAD)  # type: ignore[misc]
        gate.open()
        assert launched.end() == 0, launched.errors
    laboratory.check()
    ends = laboratory.query("SELECT DISTINCT outcome, cause FROM attempt")
    assert set(ends) == {("done", None), ("diverged", None), ("released", "killed")}


def test_all_workers_killed_at_once_cost_nothing(
    sqlite_url: str, laboratory_at: Callable[..., Laboratory]
) -> None:
    laboratory = laboratory_at(sqlite_url)
    laboratory.gate.let(10)
    with laboratory.launched() as launched:
        launched.until(lambda: len(laboratory.gate.waiting()) == 2)
        assert set(launched.workers()) == set(laboratory.gate.waiting())
        for worker in launched.workers():
            os.kill(worker, signal.SIGKILL)
        laboratory.gate.open()
        assert launched.end() == 0, launched.errors
    laboratory.check()
