"""A driver that sleeps past its lease, as a laptop with its lid closed, and wakes up again."""

from __future__ import annotations

import signal
import sqlite3
from collections.abc import Callable
from contextlib import closing

import pytest
from sqlalchemy.engine import make_url

from tests.orchestrate.faults.laboratory import Laboratory, Launched
from tests.waiting import PATIENCE_SECONDS

SHORT = {"lease": 3, "patience": PATIENCE_SECONDS}
"""Settings of a sleeper, which is alone while it is awake: nobody is there to use a late beat."""


def stop_between_transactions(sleeper: Launched, laboratory: Laboratory) -> None:
    """Stop it while it does not hold the lock of the file, for which everybody would wait."""
    path = make_url(laboratory.url).database
    while True:
        sleeper.send(signal.SIGSTOP)
        with closing(sqlite3.connect(str(path), timeout=0.5, isolation_level=None)) as connection:
            try:
                connection.execute("BEGIN IMMEDIATE")
            except sqlite3.OperationalError:
                sleeper.send(signal.SIGCONT)
            else:
                return


def test_another_launch_takes_over_and_late_results_are_refused(
    postgresql_url: str, laboratory_at: Callable[..., Laboratory]
) -> None:
    laboratory = laboratory_at(postgresql_url)
    laboratory.gate.let(20)
    with laboratory.launched(settings=SHORT) as sleeper:
        sleeper.until(lambda: laboratory.count() >= 5)
        sleeper.send(signal.SIGSTOP)
        laboratory.complete()
        taken = laboratory.query("SELECT trial_id FROM attempt WHERE outcome = 'lost'")
        assert taken, "nothing was taken from the sleeper"
        sleeper.send(signal.SIGCONT)
        assert sleeper.end() == 0, sleeper.errors
    laboratory.check()
    assert laboratory.query("SELECT trial_id FROM attempt WHERE outcome = 'lost'") == taken
    writers = laboratory.query("SELECT DISTINCT launch_id FROM trial WHERE attempt = 2")
    assert writers == [(2,)]


@pytest.mark.parametrize("moment", ["commit", "copy", "pipeline"])
def test_a_sleeper_in_a_transaction_holds_up_nobody(
    postgresql_url: str, laboratory_at: Callable[..., Laboratory], moment: str
) -> None:
    laboratory = laboratory_at(postgresql_url)
    with laboratory.launched(pause=moment, executor="inprocess", settings=SHORT) as sleeper:
        sleeper.until(lambda: sleeper.paused)
        sleeper.send(signal.SIGSTOP)
        laboratory.complete(executor="inprocess")
    assert laboratory.query("SELECT count(*) FROM attempt WHERE outcome = 'lost'") != [(0,)]


def test_a_sleeper_keeps_its_claims_where_the_kernel_knows_it(
    sqlite_url: str, laboratory_at: Callable[..., Laboratory]
) -> None:
    laboratory = laboratory_at(sqlite_url)
    laboratory.gate.let(20)
    with laboratory.launched() as sleeper, laboratory.launched() as other:
        sleeper.until(lambda: set(sleeper.workers()) & set(laboratory.gate.waiting()))
        stop_between_transactions(sleeper, laboratory)
        laboratory.gate.open()
        other.until(lambda: laboratory.count("status = 'pending'") == 0)
        sleeper.send(signal.SIGCONT)
        assert [sleeper.end(), other.end()] == [0, 0], sleeper.errors + other.errors
    laboratory.check()
    assert laboratory.count("attempt > 1") == 0
