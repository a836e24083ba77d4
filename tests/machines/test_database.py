"""The server of the database goes away for a while, for all or for one."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from tests.machines.hosts import until
from tests.machines.lab import Lab
from tests.machines.outcome import Outcome
from tests.machines.witness import PAUSE, read_notes

Measured = Callable[[str, float], None]


@pytest.mark.parametrize("mode", ["fast", "immediate"])
def test_a_launch_waits_for_a_server_that_restarts(
    lab: Lab, undisturbed: Outcome, measured: Measured, mode: str
) -> None:
    lab.start_cluster("w1", "w2")
    launched = lab.launch(witness=True)
    lab.until_done(launched, 4)
    start = time.monotonic()
    lab.database.stop(mode)
    waits = "waiting for up to 30 s"
    until(lambda: waits in launched.output, 20.0, lambda: f"'{waits}':\n{launched.output}")
    lab.database.start()
    before = lab.done()
    lab.until_done(launched, before + 1)
    measured(f"server restarted, {mode}: next trial stored", time.monotonic() - start)
    assert launched.wait() == 0, launched.output
    outcome = lab.outcome()
    outcome.check_complete(undisturbed)
    assert outcome.launches == [(1, "done")]


def test_the_late_outcomes_of_a_launch_that_was_cut_off_are_refused(
    lab: Lab, undisturbed: Outcome, measured: Measured
) -> None:
    """Past its lease another launch takes its trials; both finish them, and one counts."""
    lease = ["launch.lease=5", "launch.patience=4"]
    cut_off = lab.launch(*lease, seeds=10, witness=True, **{PAUSE: "2"})
    lab.until_done(cut_off, 1)
    other = lab.launch(*lease, seeds=10, on="desk2", witness=True)
    lab.until_done(other, 5)
    with lab.network.cut_between(lab.host("desk"), lab.host("db")):
        measured(
            "launch cut off from the database, lease of 5 s: its trials wait again",
            lab.until_rows(other, "attempt", "outcome = 'lost'"),
        )
    assert other.wait() == 0, other.output
    assert cut_off.wait() == 0, cut_off.output
    outcome = lab.outcome()
    outcome.check_complete(undisturbed, seeds=10)
    lost = outcome.attempts_of("lost")
    finished = read_notes(lab.host("desk").folder / "home", "finished")
    late = set(lost) & set(finished)
    assert late, "the launch that was cut off finished nothing that it had lost"
    for seed in late:
        assert lost[seed][5] == 1, "launch of the attempt that was lost"
        assert outcome.attempts_of("done")[seed][4:6] == ("desk2", 2)
