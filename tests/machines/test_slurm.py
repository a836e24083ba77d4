"""SLURM: one job array runs a grid, whatever happens to its tasks."""

from __future__ import annotations

import os
import random
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

import pytest

from tests.machines.hosts import Host, Process, unavailable, until
from tests.machines.lab import GRID, LAUNCH, SEEDS, Lab, Outcome
from tests.machines.waiting import SECONDS

PROGRAMS = ("slurmctld", "slurmd", "sbatch")

_CONFIGURATION = """
ClusterName=lab
SlurmctldHost=ctl({address})
SlurmUser=root
AuthType=auth/none
AuthInfo=cred_expire=5
CredType=cred/none
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool.%n
SlurmctldPidFile=/tmp/slurmctld.pid
SlurmdPidFile=/tmp/slurmd.pid
SlurmctldTimeout=10
SlurmdTimeout=10
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
MpiDefault=none
MailProg=/bin/true
JobCompType=jobcomp/filetxt
JobCompLoc={folder}/ended
ReturnToService=2
SlurmdParameters=config_overrides
SchedulerParameters=batch_sched_delay=1,sched_interval=5
{nodes}
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE
"""
"""A requeued job waits until its credential expires (``cred_expire``), by default 120 s."""


def need_slurm() -> None:
    """Skip without SLURM, or fail where the machines are required."""
    if missing := [name for name in PROGRAMS if shutil.which(name) is None]:
        unavailable(f"{' and '.join(missing)} not on PATH: install slurm-wlm")


class Slurm:
    """A cluster with nodes of so many cores.

    Attributes
    ----------
    controller
        Host on which the controller runs, and launches.
    """

    def __init__(self, lab: Lab, nodes: Sequence[str] = ("n1", "n2"), cores: int = 1) -> None:
        self.lab = lab
        self.controller = lab.host("ctl")
        self.hosts = [lab.host(name) for name in nodes]
        self.folder = self.controller.folder
        self._configure(cores)
        self.start(self.controller, "slurmctld", "-D")
        for host in self.hosts:
            self.start(host, "slurmd", "-D", "-N", host.name)
        until(self._ready, lambda: f"idle nodes:\n{self.controller.logs()}")

    def start(self, host: Host, *command: str, **environment: str) -> Process:
        """Start a program that knows the cluster."""
        settings = {"SLURM_CONF": str(self.folder / "slurm.conf"), "DOPT_DB": self.lab.database.url}
        return host.start(*command, **settings, **environment)

    def ask(self, *command: str) -> str:
        """Run a command of SLURM and return what it says, errors included."""
        process = self.start(self.controller, *command)
        process.wait()
        return process.output.strip()

    def launch(self, *words: str) -> Process:
        """Start a launch whose job runs on the cluster."""
        logs = f"executor.logs={self.folder}/logs"
        words = ("-m", "executor=slurm", logs, "launch.lease=6", "launch.patience=5", *words)
        return self.start(self.controller, sys.executable, *LAUNCH, *words)

    def tasks(self, *states: str) -> list[str]:
        """Return the tasks that are in one of the states, or in any, such as 7_1."""
        chosen = [f"--states={','.join(states)}"] if states else []
        return self.ask("squeue", "--noheader", "--array", "--format=%i", *chosen).split()

    def logs(self) -> str:
        """Return what the tasks have written."""
        return "\n".join(path.read_text() for path in sorted((self.folder / "logs").glob("*.log")))

    def runs(self) -> list[tuple[str, float]]:
        """Return the state in which each run of a task ended, and its length [s]."""
        lines = (self.folder / "ended").read_text().splitlines()
        ended = [dict(word.split("=", 1) for word in line.split() if "=" in word) for line in lines]
        return [(one["JobState"], _length(one["StartTime"], one["EndTime"])) for one in ended]

    def _configure(self, cores: int) -> None:
        (self.folder / "state").mkdir()
        names = "".join(f"{host.address} {host.name}\n" for host in (self.controller, *self.hosts))
        for host in (self.controller, *self.hosts):
            (host.folder / "hosts").write_text(f"127.0.0.1 localhost\n{names}")
            (self.folder / f"spool.{host.name}").mkdir()
        nodes = "\n".join(
            f"NodeName={host.name} NodeAddr={host.address} CPUs={cores}" for host in self.hosts
        )
        (self.folder / "slurm.conf").write_text(
            _CONFIGURATION.format(address=self.controller.address, folder=self.folder, nodes=nodes)
        )

    def _ready(self) -> bool:
        return self.ask("sinfo", "--noheader", "--Node", "--format=%t").split() == ["idle"] * len(
            self.hosts
        )


def _length(start: str, end: str) -> float:
    if "Unknown" in (start, end):
        return 0.0
    return (datetime.fromisoformat(end) - datetime.fromisoformat(start)).total_seconds()


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
    until(lambda: not slurm.tasks(), slurm.logs)
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
    until(lambda: lab.done() > 0, slurm.logs)
    [name] = slurm.ask("squeue", "--noheader", "--states=RUNNING", "--format=%N").split()
    lab.network.power_off(lab.host(name))
    until(lambda: not slurm.tasks(), slurm.logs)
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
