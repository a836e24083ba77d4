"""Kill -9 of a worker: its chunk runs again, and nobody else notices."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

from tests.orchestrate.faults.laboratory import Laboratory


def test_killed_workers_cost_nothing(laboratory: Laboratory) -> None:
    with laboratory.launched() as launched:
        for done in (5, 15, 25):
            launched.until(lambda done=done: laboratory.count() >= done)  # type: ignore[misc]
            os.kill(launched.workers()[0], signal.SIGKILL)
        assert launched.end() == 0, launched.errors
    laboratory.check()
    ends = laboratory.query("SELECT DISTINCT outcome, cause FROM attempt")
    assert set(ends) == {("done", None), ("diverged", None), ("released", "killed")}


def test_all_workers_killed_at_once_cost_nothing(
    sqlite_url: str, laboratory_at: Callable[..., Laboratory]
) -> None:
    laboratory = laboratory_at(sqlite_url)
    with laboratory.launched() as launched:
        launched.until(lambda: laboratory.count() >= 5)
        for worker in launched.workers():
            os.kill(worker, signal.SIGKILL)
        assert launched.end() == 0, launched.errors
    laboratory.check()
