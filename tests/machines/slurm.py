"""A SLURM cluster on hosts of a lab: a controller, from which jobs are submitted, and nodes."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from datetime import datetime

from tests.machines import servers
from tests.machines.hosts import Host, Process, until
from tests.machines.lab import Lab
from tests.machines.requirements import unavailable

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
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    if not missing:
        return
    message = f"{' and '.join(missing)} not on PATH: install slurm-wlm"
    unavailable(message)


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
        until(self._ready, 30.0, lambda: f"idle nodes:\n{self.controller.logs()}")

    def start(self, host: Host, *command: str, **environment: str) -> Process:
        """Start a program that knows the cluster."""
        settings = {"SLURM_CONF": str(self.folder / "slurm.conf"), "DOPT_DB": self.lab.database.url}
        return host.start(*command, **settings, **environment)

    def ask(self, *command: str) -> str:
        """Run a command of SLURM and return what it says, errors included."""
        process = self.start(self.controller, *command)
        process.wait(30.0)
        return process.output.strip()

    def launch(self, *words: str) -> Process:
        """Start a launch whose job runs on the cluster."""
        logs = f"executor.logs={self.folder}/logs"
        words = ("-m", "executor=slurm", logs, "launch.lease=6", "launch.patience=5", *words)
        return self.start(self.controller, sys.executable, *servers.LAUNCH, *words)

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
