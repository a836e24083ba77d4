"""Thousands of trials on workers that pull, one of which is preempted every second."""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import pytest

from tests.orchestrate.faults.laboratory import Laboratory
from tests.orchestrate.faults.preemptions import preempt
from tests.orchestrate.faults.test_workers import register

TRIALS = 5_000
"""Trials on each database, unless DOPT_SOAK_TRIALS says how many."""

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1800)]


def test_workers_survive_a_preemption_every_second_or_two(
    request: pytest.FixtureRequest, url: str, laboratory_at: Callable[..., Laboratory]
) -> None:
    trials = int(os.environ.get("DOPT_SOAK_TRIALS", TRIALS))
    laboratory = laboratory_at(url, trials, seconds=0.05)
    register(laboratory)
    sent = preempt(laboratory, workers=3, every=50, chance=random.Random(2), lease=2.0)
    laboratory.check()
    assert laboratory.count("status = 'failed'") == 0
    attempts = laboratory.query("SELECT outcome, count(*) FROM attempt GROUP BY 1 ORDER BY 1")
    terminal = request.config.get_terminal_writer()
    terminal.line(f"\n{trials:,} trials, signals {dict(sent)}, attempts {dict(attempts)}")
    assert sent.total() >= 10
