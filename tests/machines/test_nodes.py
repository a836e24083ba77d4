"""A grid on a Ray cluster of several hosts, of which some are lost on the way and others come."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.machines.hosts import Process, until
from tests.machines.lab import Lab
from tests.machines.outcome import Outcome
from tests.machines.witness import HOLD, PAUSE, let_go, read_notes

Measured = Callable[[str, float], None]

RELEASED = "outcome = 'released'"


def test_all_hosts_work(lab: Lab, undisturbed: Outcome) -> None:
    lab.start_cluster("w1", "w2", **{HOLD: "1"})
    launched = lab.launch(witness=True)
    for worker in ("w1", "w2"):
        begun(lab, launched, worker)
    for worker in ("w1", "w2"):
        let_go(home_of(lab, worker))
    assert launched.wait() == 0, launched.output
    outcome = lab.outcome()
    outcome.check_complete(undisturbed)
    assert [node for node, _ in outcome.nodes] == ["w1", "w2"]
    assert outcome.launches == [(1, "done")]


def test_a_host_that_joins_in_mid_run_is_used(
    lab: Lab, undisturbed: Outcome, measured: Measured
) -> None:
    lab.start_cluster("w1", **{PAUSE: "1.5"})
    launched = lab.launch(witness=True)
    lab.until_done(launched, 2)
    lab.add_worker("w2", **{PAUSE: "1.5"})
    seconds = until(
        lambda: lab.count("trial", "node = 'w2'") > 0 or not launched.running, 120.0,
        lambda: f"trial on w2:\n{launched.output}",
    )  # fmt: skip
    measured("host added: first trial of it", seconds)
    assert launched.wait() == 0, launched.output
    outcome = lab.outcome()
    outcome.check_complete(undisturbed)
    assert [node for node, _ in outcome.nodes] == ["w1", "w2"]


@pytest.mark.parametrize("fault", ["power off", "link cut"])
def test_a_host_that_is_lost_costs_nothing(
    lab: Lab, undisturbed: Outcome, measured: Measured, fault: str
) -> None:
    """The lost host holds a trial until it is released, so that there is one to release."""
    lab.start_cluster("w1", "w2", **{HOLD: "1"})
    let_go(home_of(lab, "w2"))
    launched = lab.launch(witness=True)
    begun(lab, launched, "w1")
    lab.until_done(launched, 4)
    if fault == "power off":
        lab.network.power_off(lab.host("w1"))
        seconds = lab.until_rows(launched, "attempt", RELEASED)
    else:
        with lab.network.link_cut(lab.host("w1")):
            seconds = lab.until_rows(launched, "attempt", RELEASED)
        let_go(home_of(lab, "w1"))  # a host that is back before Ray gives it up gets trials again
    measured(f"{fault}: its trials wait again", seconds)
    assert launched.wait() == 0, launched.output
    outcome = lab.outcome()
    outcome.check_complete(undisturbed)
    assert {row[3] for row in outcome.attempts if row[2] == "released"} == {"node lost"}


def test_a_short_cut_is_not_even_noticed(lab: Lab, undisturbed: Outcome) -> None:
    lab.start_cluster("w1", "w2")
    launched = lab.launch(witness=True)
    lab.until_done(launched, 4)
    with lab.network.link_cut(lab.host("w1")):
        time.sleep(1.0)
    assert launched.wait() == 0, launched.output
    outcome = lab.outcome()
    outcome.check_complete(undisturbed)
    assert not outcome.attempts_of("released")


def test_a_host_that_lost_head_and_launch_ends_its_trial_in_vain(
    lab: Lab, undisturbed: Outcome, measured: Measured
) -> None:
    """It reaches all others, the database too, and goes on: its trial ends twice, counts once."""
    lab.start_cluster("w1", "w2", **{PAUSE: "20"})
    launched = lab.launch(seeds=4, on="head", witness=True)
    seed = begun(lab, launched, "w1")
    with lab.network.cut_between(lab.host("head"), lab.host("w1")):
        seconds = lab.until_rows(launched, "attempt", RELEASED)
        requeued = time.time()
        measured("cut from head and launch: its trials wait again", seconds)
        until(lambda: seed in notes(lab, "w1", "finished"), 60.0, lambda: "end of it on w1")
    assert launched.wait(200.0) == 0, launched.output
    assert notes(lab, "w1", "finished")[seed] > requeued
    assert seed in notes(lab, "w2", "finished")
    outcome = lab.outcome()
    outcome.check_complete(undisturbed, seeds=4)
    assert outcome.attempts_of("released")[seed][1] == 1
    assert outcome.attempts_of("done")[seed][4] == "w2"
    assert outcome.nodes == [("w2", 4)]


def test_a_host_that_lost_only_the_head_goes_on_for_a_launch_elsewhere(
    lab: Lab, undisturbed: Outcome
) -> None:
    """The launch still hears its worker, so that nothing is lost or run again.

    The trial ends after the head has seen the cut, however long that takes.
    """
    lab.start_cluster("w1", "w2", **{HOLD: "1"})
    let_go(home_of(lab, "w2"))
    launched = lab.launch(seeds=4, witness=True)
    seed = begun(lab, launched, "w1")
    with lab.network.cut_between(lab.host("head"), lab.host("w1")):
        lab.until_head_lost("w1")
        let_go(home_of(lab, "w1"))
        assert launched.wait(200.0) == 0, launched.output
    outcome = lab.outcome()
    outcome.check_complete(undisturbed, seeds=4)
    assert outcome.attempts_of("done")[seed][4] == "w1"
    assert len(outcome.attempts) == 4


def begun(lab: Lab, launched: Process, host: str) -> int:
    """Return the first trial of the host, once it has begun."""
    until(
        lambda: notes(lab, host, "begun"), 90.0, lambda: f"trial on {host}:\n{launched.output}"
    )  # fmt: skip
    return next(iter(notes(lab, host, "begun")))


def notes(lab: Lab, host: str, kind: str) -> dict[int, float]:
    return read_notes(home_of(lab, host), kind)


def home_of(lab: Lab, host: str) -> Path:
    return lab.host(host).folder / "home"


def test_a_token_opens_the_cluster_and_appears_nowhere(lab: Lab, undisturbed: Outcome) -> None:
    token = "a-secret-of-this-cluster-0123456789abcdef"
    secret = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": token}
    lab.start_cluster("w1", **secret)
    refused = lab.launch(seeds=2, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=f"{token}x")
    assert refused.wait() == 75
    assert "error: Ray cannot be reached" in refused.output
    launched = lab.launch(seeds=2, **secret)
    assert launched.wait() == 0, launched.output
    lab.outcome().check_complete(undisturbed, seeds=2)
    everything = lab.host("db").run("pg_dump", "-h", "/tmp", "-U", "postgres", "postgres")
    assert token not in refused.output + launched.output + everything
