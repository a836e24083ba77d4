"""docs/example/slurm_workers.sh runs a grid as a job array, whatever happens to its tasks."""

from __future__ import annotations

import os
import random
import shutil
import sys
import time
from pathlib import Path

import pytest

from tests.machines.hosts import Host, Process, unavailable, until
from tests.machines.lab import GRID, LAUNCH, SEEDS, Lab, Outcome
from tests.paths import ROOT

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
ReturnToService=2
SlurmdParameters=config_overrides
SchedulerParameters=batch_sched_delay=1,sched_interval=5
{nodes}
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE
"""
"""A requeued job waits until its credential expires (``cred_expire``), by default 120 s."""


class Slurm:
    """A cluster with two nodes of one core.

    Attributes
    ----------
    controller
        Host on which the controller runs, and launches.
    """

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.controller = lab.host("ctl")
        self.hosts = [lab.host(name) for name in ("n1", "n2")]
        self.folder = self.controller.folder
        self._configure()
        self.start(self.controller, "slurmctld", "-D")
        for host in self.hosts:
            self.start(host, "slurmd", "-D", "-N", host.name)
        until(self._ready, lambda: f"idle nodes:\n{self.controller.logs()}")

    def start(self, host: Host, *command: str) -> Process:
        """Start a program that knows the cluster and the database."""
        return host.start(
            *command,
            SLURM_CONF=str(self.folder / "slurm.conf"),
            DOPT_DB=self.lab.database.url,
            PATH=f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        )

    def ask(self, *command: str) -> str:
        """Run a command of SLURM and return what it says, errors included."""
        process = self.start(self.controller, *command)
        process.wait()
        return process.output.strip()

    def submit(self, trials: int, tasks: int) -> None:
        """Register a grid, and submit its workers."""
        grid = ("-m", *GRID, f"seed=range({trials})", "launch.detach=true")
        launched = self.start(self.controller, sys.executable, *LAUNCH, *grid)
        assert launched.wait() == 0, launched.output
        options = (f"--array=1-{tasks}", "--cpus-per-task=1", "--time=30", f"--chdir={ROOT}")
        said = self.ask("sbatch", *options, f"--output={self.folder}/%a.log", SCRIPT, "--lease=6")
        assert said.startswith("Submitted batch job"), said

    def tasks(self, *states: str) -> list[str]:
        """Return the tasks that are in one of the states, or in any, such as 7_1."""
        chosen = [f"--states={','.join(states)}"] if states else []
        return self.ask("squeue", "--noheader", "--array", "--format=%i", *chosen).split()

    def logs(self) -> str:
        """Return what the tasks have written."""
        return "\n".join(path.read_text() for path in sorted(self.folder.glob("[0-9].log")))

    def _configure(self) -> None:
        (self.folder / "state").mkdir()
        names = "".join(f"{host.address} {host.name}\n" for host in (self.controller, *self.hosts))
        for host in (self.controller, *self.hosts):
            (host.folder / "hosts").write_text(f"127.0.0.1 localhost\n{names}")
            (self.folder / f"spool.{host.name}").mkdir()
        nodes = "\n".join(
            f"NodeName={host.name} NodeAddr={host.address} CPUs=1" for host in self.hosts
        )
        (self.folder / "slurm.conf").write_text(
            _CONFIGURATION.format(address=self.controller.address, folder=self.folder, nodes=nodes)
        )

    def _ready(self) -> bool:
        return self.ask("sinfo", "--noheader", "--Node", "--format=%t").split() == ["idle"] * len(
            self.hosts
        )


SCRIPT = "docs/example/slurm_workers.sh"

TRIALS = 800
SECONDS_BETWEEN_PREEMPTIONS = 5.0
FEWEST_PREEMPTIONS = 3

PREEMPTIONS = (
    ("scontrol", "requeue"),
    ("scancel", "--batch", "--signal=USR1"),  # as with a time of grace
    ("scancel", "--full", "--signal=TERM"),
)


@pytest.fixture
def slurm(lab: Lab) -> Slurm:
    if missing := [name for name in PROGRAMS if shutil.which(name) is None]:
        unavailable(f"{' and '.join(missing)} not on PATH: install slurm-wlm")
    return Slurm(lab)


def test_preempted_tasks_lose_double_and_fail_nothing(
    slurm: Slurm, lab: Lab, undisturbed: Outcome
) -> None:
    slurm.submit(TRIALS, tasks=4)
    chance, preempted = random.Random(1), 0
    while slurm.tasks():  # the last ones are cancelled where every trial has an outcome
        time.sleep(SECONDS_BETWEEN_PREEMPTIONS)
        if running := slurm.tasks("RUNNING"):
            slurm.ask("timeout", "5", *chance.choice(PREEMPTIONS), chance.choice(running))
            preempted += 1
    assert preempted >= FEWEST_PREEMPTIONS
    outcome = lab.outcome()
    assert [row[1] for row in outcome.trials] == ["done"] * TRIALS, slurm.logs()
    assert [row[0] for row in outcome.attempts if row[2] == "done"] == list(range(TRIALS))
    assert {row[2] for row in outcome.attempts} <= {"done", "released", "lost"}
    first = [[row for row in rows if row[0] < SEEDS] for rows in outcome.results]
    assert first == undisturbed.results
    # 28 minutes and some seconds, by what SLURM says of the end of the task
    argv = lab.ask("SELECT argv FROM launch WHERE argv LIKE '%--until%' LIMIT 1")
    assert any(f"--until={seconds}s" in argv for seconds in range(28 * 60 - 30, 28 * 60 + 1)), argv


def test_a_task_whose_node_is_lost_runs_elsewhere(
    slurm: Slurm, lab: Lab, undisturbed: Outcome
) -> None:
    slurm.submit(SEEDS, tasks=1)
    until(lambda: lab.done() > 0, slurm.logs)
    [name] = slurm.ask("squeue", "--noheader", "--states=RUNNING", "--format=%N").split()
    lab.network.power_off(lab.host(name))
    until(lambda: not slurm.tasks(), slurm.logs)
    lab.outcome().check_complete(undisturbed)
