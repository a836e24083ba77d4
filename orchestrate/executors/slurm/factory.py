"""Factory of the jobs of ``executor=slurm``, and the facts that are checked before a submission."""

from __future__ import annotations

import shutil
import socket
import subprocess

from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import LaunchError
from orchestrate.executors.factory import ExecutorFactory
from orchestrate.executors.slurm.job import SlurmJob
from orchestrate.redaction import without_password

_MOST_NAMED = 3


def _check(settings: LaunchSettings) -> None:
    options = SlurmJob.of(settings).options
    if shutil.which("sbatch") is None:
        raise LaunchError(
            "executor=slurm submits a job by sbatch, which is not on PATH here: launch on a "
            "machine of the cluster, or print the job with launch.dry_run=true."
        )
    if not settings.store_url.startswith("sqlite"):
        return
    others = _hosts(options.partition) - {socket.gethostname(), socket.gethostname().split(".")[0]}
    if others:
        named = ", ".join([*sorted(others)[:_MOST_NAMED], *["..."] * (len(others) > _MOST_NAMED)])
        raise LaunchError(
            f"The results database {without_password(settings.store_url)} is a file of this "
            f"machine, which the nodes {named} do not see: use PostgreSQL (store=postgresql), or "
            "let each task of a job array of your own run a share of the grid (store=shards "
            "launch.share=3/20 executor=local)."
        )


def _hosts(partition: str | None) -> set[str]:
    """Return the names of the machines on which the tasks may run."""
    chosen = [f"--partition={partition}"] if partition else []
    done = subprocess.run(
        ["sinfo", "--noheader", "--format=%n", *chosen],
        capture_output=True,
        text=True,
        check=False,
    )
    hosts = set(done.stdout.split())
    if done.returncode or not hosts:
        reason = (done.stderr.strip() or "no node").splitlines()[-1]
        raise LaunchError(
            f"sinfo names no node on which tasks could run ({reason}): see whether SLURM runs and "
            "executor.partition exists."
        )
    return hosts


FACTORY = ExecutorFactory(
    make=None,
    trials_at_once=lambda _: None,
    check=_check,
    job=SlurmJob.of,
    limiting_key="executor.cpus_per_task",
)
