"""SLURM: one job array runs a grid, whatever happens to its tasks."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.machines.hosts import until
from tests.machines.lab import GRID, SEEDS, Lab
from tests.machines.outcome import Outcome
from tests.machines.slurm import Slurm, need_slurm
from tests.machines.waiting import SECONDS

TRIALS = 400
SECONDS_BETWEEN_PREEMPTIONS = 5.0
FEWEST_PREEMPTIONS = 3

WAITING_TRIALS = 10_000
"""Trials that wait, unless DOPT_SLURM_TRIALS says how many."""

LEAST_COMPUTING = 0.9
"""Share of the walltime that goes to trials, of which there are enough to outweigh the starts."""

CONF = Path(__file__).parent / "conf"

PREEMPTIONS = (
    ("scontrol", "requeue"),
    ("scancel", "--batch", "--signal=USR1"),  # as with a time of grace
    ("scancel", "--full", "--signal=TERM"),
)


@pytest.fixture
def slurm(lab: Lab) -> Slurm:
    need_slurm()
    return Slurm(lab)


def test_an_array_runs_a_grid_and_ends(slurm: Slurm, lab: Lab, undisturbed: Outcome) -> None:
    comment = "+executor.options.comment='a b'"
    launched = slurm.launch(*GRID, f"seed=range({SEEDS})", "executor.time=30m",
                            "executor.tasks=3", "executor.cpus_per_task=1", comment)  # fmt: skip
    assert launched.wait() == 0, launched.output
    assert f"0 of {SEEDS} already done, {SEEDS} registered" in launched.output
    assert "job 1: 3 tasks of 1 processes for 30 minutes" in launched.output
    until(lambda: not slurm.tasks(), 120.0, slurm.logs)
    lab.outcome().check_complete(undisturbed)
    # 28 minutes and some seconds, by what SLURM says of the end of the task
    argv = lab.ask("SELECT argv FROM launch WHERE argv LIKE '%--until%' LIMIT 1")
    assert any(f"{seconds}s" in argv for seconds in range(28 * 60 - 30, 28 * 60 + 1)), argv
    again = slurm.launch(*GRID, f"seed=range({SEEDS})")
    assert again.wait() == 0, again.output
    assert f"{SEEDS} of {SEEDS} already done, 0 registered" in again.output
    assert "job" not in again.output


def test_preempted_tasks_lose_double_and_fail_nothing(
    slurm: Slurm, lab: Lab, undisturbed: Outcome
) -> None:
    launched = slurm.launch(*GRID, f"seed=range({TRIALS})", "executor.time=30m",
                            "executor.tasks=4", "executor.cpus_per_task=1")  # fmt: skip
    assert launched.wait() == 0, launched.output
    preempt(slurm)
    outcome = lab.outcome()
    check_each_done_once(outcome, TRIALS, slurm)
    first = [[row for row in rows if row[0] < SEEDS] for rows in outcome.results]
    assert first == undisturbed.results


@pytest.mark.timeout(1800)
def test_preempted_tasks_compute_most_of_their_walltime(
    lab: Lab, measured: Callable[[str, float], None]
) -> None:
    """Trials that wait take no processor, so that tasks are as if each had cores of its own."""
    need_slurm()
    slurm = Slurm(lab, cores=4)
    trials = int(os.environ.get("DOPT_SLURM_TRIALS", WAITING_TRIALS))
    waiting = ("policy=waiting", "env=pendulum", "env.horizon=10", f"seed=range({trials})")
    launched = slurm.launch(f"--config-dir={CONF}", *waiting, "executor.time=1h",
                            "executor.tasks=8", "executor.cpus_per_task=1")  # fmt: skip
    assert launched.wait() == 0, launched.output
    preempted = preempt(slurm)
    check_each_done_once(lab.outcome(), trials, slurm)
    walltime = sum(seconds for _, seconds in slurm.runs())
    computing = trials * SECONDS / walltime
    measured(
        f"of walltime, {computing:.1%} computing {trials:,} trials, {preempted} preemptions",
        walltime,
    )
    assert trials < WAITING_TRIALS or computing >= LEAST_COMPUTING


def preempt(slurm: Slurm) -> int:
    """Preempt one of the running tasks every few seconds until none is left; return how often."""
    chance, preempted = random.Random(1), 0
    while slurm.tasks():
        time.sleep(SECONDS_BETWEEN_PREEMPTIONS)
        if running := slurm.tasks("RUNNING"):
            slurm.ask("timeout", "5", *chance.choice(PREEMPTIONS), chance.choice(running))
            preempted += 1
    assert preempted >= FEWEST_PREEMPTIONS
    return preempted


def check_each_done_once(outcome: Outcome, trials: int, slurm: Slurm) -> None:
    assert [row[1] for row in outcome.trials] == ["done"] * trials, slurm.logs()
    assert [row[0] for row in outcome.attempts if row[2] == "done"] == list(range(trials))
    assert {row[2] for row in outcome.attempts} <= {"done", "released", "lost"}


def test_a_task_whose_node_is_lost_runs_elsewhere(
    slurm: Slurm, lab: Lab, undisturbed: Outcome
) -> None:
    launched = slurm.launch(*GRID, f"seed=range({SEEDS})", "executor.time=30m",
                            "executor.tasks=1", "executor.cpus_per_task=1")  # fmt: skip
    assert launched.wait() == 0, launched.output
    until(lambda: lab.done() > 0, 60.0, slurm.logs)
    [name] = slurm.ask("squeue", "--noheader", "--states=RUNNING", "--format=%N").split()
    lab.network.power_off(lab.host(name))
    until(lambda: not slurm.tasks(), 240.0, slurm.logs)
    lab.outcome().check_complete(undisturbed)


def test_what_slurm_refuses_is_said_in_one_sentence(slurm: Slurm, lab: Lab) -> None:
    grid = ("env=pendulum", "policy=random", "seed=range(2)", "env.horizon=5")
    wrong = slurm.launch(*grid, "executor.partition=fast")
    assert wrong.wait() == 2
    assert "sbatch takes no job (Invalid partition name specified)" in wrong.output
    assert lab.count("trial", "status = 'pending'") == 2
    file = slurm.launch(*grid, f"store.url=sqlite:///{slurm.folder}/results.db")
    assert file.wait() == 2
    assert "is a file of this machine, which the nodes n1, n2 do not see" in file.output
    assert not (slurm.folder / "results.db").exists()
