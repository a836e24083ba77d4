"""A grid on a Ray cluster of several hosts: nodes, head and database are lost."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.machines.hosts import Process, until
from tests.machines.lab import Lab, Outcome, leave
from tests.machines.witness import HOLD, PAUSE, let_go, read_notes
from tests.paths import ROOT

Measured = Callable[[str, float], None]

RELEASED = "outcome = 'released'"


def test_all_hosts_work(lab: Lab, undisturbed: Outcome) -> None:
    lab.start_cluster("w1", "w2", **{HOLD: "1"})
    launched = lab.launch(witness=True)
    for worker in ("w1", "w2"):
        begun(lab, launched, worker)
    for worker in ("w1", "w2"):
        let_go(home_of(lab, worker))
    outcome = lab.completed(undisturbed, launched)
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
        lambda: lab.count("trial", "node = 'w2'") > 0 or not launched.running,
        lambda: f"trial on w2:\n{launched.output}",
    )  # fmt: skip
    measured("host added: first trial of it", seconds)
    outcome = lab.completed(undisturbed, launched)
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
    outcome = lab.completed(undisturbed, launched)
    assert {row[3] for row in outcome.attempts if row[2] == "released"} == {"node lost"}


def test_a_short_cut_is_not_even_noticed(lab: Lab, undisturbed: Outcome) -> None:
    lab.start_cluster("w1", "w2")
    launched = lab.launch(witness=True)
    lab.until_done(launched, 4)
    with lab.network.link_cut(lab.host("w1")):
        time.sleep(1.0)
    outcome = lab.completed(undisturbed, launched)
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
        until(lambda: seed in notes(lab, "w1", "finished"), lambda: "end of it on w1")
    assert launched.wait() == 0, launched.output
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
        outcome = lab.completed(undisturbed, launched, seeds=4)
    assert outcome.attempts_of("done")[seed][4] == "w1"
    assert len(outcome.attempts) == 4


def test_a_host_of_other_code_is_refused_before_it_computes_anything(lab: Lab) -> None:
    other = lab.host("w1").folder / "other"
    for package in ("dopt", "orchestrate"):
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, other / package, symlinks=True, ignore=ignore)
    with (other / "dopt/result.py").open("a") as source:
        source.write("# other\n")
    lab.start_cluster()
    lab.add_worker("w1", PYTHONPATH=str(other))
    launched = lab.launch(seeds=4)
    assert launched.wait() == 75
    assert "on node w1 the code of dopt is" in launched.output
    assert lab.count("trial", "status = 'pending'") == 4


def begun(lab: Lab, launched: Process, host: str) -> int:
    """Return the first trial of the host, once it has begun."""
    until(lambda: notes(lab, host, "begun"), lambda: f"trial on {host}:\n{launched.output}")
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
    lab.completed(undisturbed, launched, seeds=2)
    everything = lab.host("db").run("pg_dump", "-h", "/tmp", "-U", "postgres", "postgres")
    assert token not in refused.output + launched.output + everything


@pytest.mark.parametrize("fault", ["power off", "gcs_server stopped"])
def test_without_its_head_a_launch_ends_and_a_new_cluster_completes_it(
    lab: Lab, undisturbed: Outcome, measured: Measured, fault: str
) -> None:
    lab.start_cluster("w1", "w2")
    launched = lab.launch(witness=True)
    lab.until_done(launched, 4)
    start = time.monotonic()
    if fault == "power off":
        lab.network.power_off(lab.host("head"))
    else:
        lab.host("head").run("pkill", "-STOP", "gcs_server")  # its port still takes connections
    until(lambda: lab.count("trial", "status = 'running'") == 0, lambda: "free claim")
    measured(f"head, {fault}: claims free", time.monotonic() - start)
    assert launched.wait() == 75, launched.output
    measured(f"head, {fault}: exit 75", time.monotonic() - start)
    assert "error: The head of the Ray cluster at 10.77.0." in launched.output
    assert "Traceback" not in launched.output
    before = lab.done()
    assert 4 <= before < len(undisturbed.trials)

    if fault != "power off":
        lab.network.power_off(lab.host("head"))
    lab.network.replace(lab.host("head"))
    with ThreadPoolExecutor() as threads:
        list(threads.map(leave, map(lab.host, ("desk", "w1", "w2"))))
    lab.start_cluster("w1", "w2")
    again = lab.launch()
    outcome = lab.completed(undisturbed, again)
    assert f"{before} of {len(undisturbed.trials)} already done" in again.output
    assert outcome.launches == [(1, "failed"), (2, "done")]


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
    until(lambda: waits in launched.output, lambda: f"'{waits}':\n{launched.output}")
    lab.database.start()
    before = lab.done()
    lab.until_done(launched, before + 1)
    measured(f"server restarted, {mode}: next trial stored", time.monotonic() - start)
    outcome = lab.completed(undisturbed, launched)
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
    outcome = lab.completed(undisturbed, other, cut_off, seeds=10)
    lost = outcome.attempts_of("lost")
    finished = read_notes(lab.host("desk").folder / "home", "finished")
    late = set(lost) & set(finished)
    assert late, "the launch that was cut off finished nothing that it had lost"
    for seed in late:
        assert lost[seed][5] == 1, "launch of the attempt that was lost"
        assert outcome.attempts_of("done")[seed][4:6] == ("desk2", 2)
