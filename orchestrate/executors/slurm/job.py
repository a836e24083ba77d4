"""Job array of a grid: its script, and its submission by ``sbatch``."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import InfrastructureError, LaunchError
from orchestrate.executors.slurm.options import LEAVE_SECONDS, SlurmOptions
from orchestrate.executors.worker_environment import module_path

TASK = Path(__file__).with_name("task.sh")

_UNREACHABLE = ("contact slurm controller", "timed out")


@dataclass(frozen=True)
class SlurmJob:
    """Job array whose tasks run ``python -m orchestrate work``."""

    settings: LaunchSettings
    options: SlurmOptions

    @classmethod
    def of(cls, settings: LaunchSettings) -> SlurmJob:
        """Return the job for the settings; raise ``LaunchError`` for wrong ones."""
        if settings.workers is not None:
            raise LaunchError(
                f"launch.workers is {settings.workers}, but executor=slurm runs a trial on each "
                "core of a task: set executor.cpus_per_task, and leave launch.workers out."
            )
        return cls(settings, SlurmOptions.from_mapping(settings.executor_options))

    def text(self, trials: int) -> str:
        """Return the script for a grid with so many trials to run; it names no database."""
        return "\n".join(
            [
                "#!/bin/bash",
                "#SBATCH --job-name=dopt",
                *(f"#SBATCH {line}" for line in self.options.lines(trials)),
                f"workers=({shlex.join(self._command)})",
                f"walltime={60 * self.options.minutes} leave={LEAVE_SECONDS} # seconds",
                TASK.read_text().rstrip(),
            ]
        )

    def submit(self, trials: int, environment: Mapping[str, str]) -> str:
        """Submit the script and return what to say of it.

        ``environment`` is added to the variables of this process, which the tasks get.

        Raises
        ------
        LaunchError, InfrastructureError
            If SLURM refuses the job, or cannot be reached.
        """
        _make_folder(self.options.logs)
        done = subprocess.run(
            ["sbatch", "--parsable"],
            input=self.text(trials),
            env={**os.environ, **module_path(), **environment},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise _refusal(done.stderr)
        return self._submitted(done.stdout.strip().split(";")[0], trials)

    def _submitted(self, job: str, trials: int) -> str:
        options = self.options
        tasks = options.tasks_for(trials)
        return (
            f"job {job}: {tasks} task{'s' * (tasks > 1)} of {options.cpus_per_task} processes for "
            f"{options.minutes} minutes, output in {options.logs}/{job}_*.log\n"
            f"watch it with python -m orchestrate status --db {self.settings.store_url} "
            f"or squeue --job={job}"
        )

    @property
    def _command(self) -> list[str]:
        """Command of the workers; no trial may take longer than the task."""
        timeout = self.settings.timeout or 60 * self.options.minutes
        given = {
            "processes": self.options.cpus_per_task,
            "timeout": f"{timeout:g}",
            "lease": f"{self.settings.lease:g}",
        }
        if self.settings.memory_gib is not None:
            given["memory-gib"] = f"{self.settings.memory_gib:g}"
        if self.settings.retry_memory is not None:
            given["retry-memory"] = f"{self.settings.retry_memory:g}"
        words = (word for name, value in given.items() for word in (f"--{name}", str(value)))
        return [sys.executable, "-P", "-m", "orchestrate", "work", *words]


def _make_folder(logs: Path) -> None:
    """Make the folder without which SLURM ends a task before it has begun."""
    try:
        logs.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LaunchError(
            f"executor.logs is '{logs}', a folder that cannot be made ({error.strerror}): give "
            "another one on a disk that the nodes see, and run the same command again."
        ) from error


def _refusal(errors: str) -> LaunchError | InfrastructureError:
    """Return the error for what ``sbatch`` says, whose last line gives the reason."""
    last = (errors.strip() or "no reason given").splitlines()[-1]
    reason = last.removeprefix("sbatch: error: ").removeprefix("Batch job submission failed: ")
    sentence = f"sbatch takes no job ({reason}), but the grid is registered"
    if any(words in last for words in _UNREACHABLE):
        return InfrastructureError(f"{sentence}: run the same command again later.")
    return LaunchError(f"{sentence}: change executor.* and run the same command again.")
