"""Job array of ``executor=slurm``: its options, its script, and the checks before a submission."""

from __future__ import annotations

import math
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dopt.errors import DoptError, given_path
from orchestrate.config.launch_settings import LaunchSettings, count, limit, section, text, wrong
from orchestrate.errors import InfrastructureError, LaunchError, without_password
from orchestrate.executors.base import ExecutorFactory
from orchestrate.executors.limits import module_path
from orchestrate.program import length_of_time

LEAVE_SECONDS = 120
"""Time before the end of a task at which its workers hold nothing any more.

SLURM sends the warning at most 60 s earlier than it is asked for.
"""

WARN_SECONDS = 60
LEAST_MINUTES = 5

_SETTINGS = {
    "account": "account",
    "array": "tasks",
    "cpus-per-task": "cpus_per_task",
    "mem": "memory_gib",
    "output": "logs",
    "partition": "partition",
    "time": "time",
}
_FIXED = ("export", "no-requeue", "nodes", "ntasks", "open-mode", "requeue", "signal")

_OWN = {
    **{name: f"--{{}} is set by executor.{setting}" for name, setting in _SETTINGS.items()},
    **dict.fromkeys(_FIXED, "every job sets --{} as its workers need it"),
}
"""Options of ``sbatch`` that a job sets itself, with the reason not to set them again."""

_NAME = re.compile(r"[a-z][a-z-]*")


@dataclass(frozen=True)
class SlurmOptions:
    """Resources of a job array.

    Attributes
    ----------
    tasks
        Largest number of array tasks.
    cpus_per_task
        Cores of a task, on one node; each runs a trial.
    minutes
        Walltime of a task.
    memory_gib
        Memory of a task, or None for the default of the cluster.
    partition, account
        Names of the cluster, or None for its defaults.
    logs
        Folder of the output of the tasks, on a disk that the nodes see.
    extra
        Further options of ``sbatch`` by their long names; None for one without a value.
    """

    tasks: int
    cpus_per_task: int
    minutes: int
    memory_gib: float | None
    partition: str | None
    account: str | None
    logs: Path
    extra: Mapping[str, str | None] = field(default_factory=dict)

    @classmethod
    def from_mapping(cls, given: Mapping[str, Any]) -> SlurmOptions:
        """Check the section ``executor`` of a configuration.

        Raises
        ------
        LaunchError, UsageError
            If a value has the wrong type or is out of bounds.
        """
        return cls(
            tasks=_number("tasks", given.get("tasks")),
            cpus_per_task=_number("cpus_per_task", given.get("cpus_per_task")),
            minutes=_minutes(given.get("time")),
            memory_gib=limit("executor.memory_gib", given.get("memory_gib"), "GiB"),
            partition=_word("partition", given.get("partition")),
            account=_word("account", given.get("account")),
            logs=given_path(text("executor.logs", given.get("logs")), "executor.logs", LaunchError),
            extra=dict(_extra(section("executor.options", given.get("options", {})))),
        )

    def lines(self, trials: int) -> Iterator[str]:
        """Yield the options of ``sbatch`` for a grid with so many trials to run."""
        yield f"--array=1-{self.tasks_for(trials)}"
        yield f"--nodes=1 --ntasks=1 --cpus-per-task={self.cpus_per_task}"
        yield f"--time={self.minutes}"
        if self.memory_gib is not None:
            yield f"--mem={math.ceil(1024 * self.memory_gib)}M"
        for name in ("partition", "account"):
            if value := getattr(self, name):
                yield f"--{name}={value}"
        yield f"--output={_quoted(f'{self.logs}/%A_%a.log')} --open-mode=append"
        yield f"--requeue --signal=B:USR1@{WARN_SECONDS} --export=ALL"
        for name, value in self.extra.items():
            yield f"--{name}" if value is None else f"--{name}={_quoted(value)}"

    def tasks_for(self, trials: int) -> int:
        """Return the number of array tasks, of which none is to be without a trial."""
        return max(1, min(self.tasks, math.ceil(trials / self.cpus_per_task)))


def _number(key: str, value: object) -> int:
    if (number := count(f"executor.{key}", value)) is None:
        raise wrong(f"executor.{key}", None, "a whole number above 0")
    return number


def _minutes(value: object) -> int:
    try:
        minutes = math.ceil(length_of_time("executor.time")(str(value)) / 60)
    except DoptError:
        minutes = 0
    if minutes < LEAST_MINUTES:
        raise wrong("executor.time", value, f"a time from {LEAST_MINUTES}m on, such as 55m or 4h,")
    return minutes


def _word(key: str, value: object) -> str | None:
    """Return a name of the cluster."""
    if value is None or (isinstance(value, str) and re.fullmatch(r"[\w.,@+-]+", value)):
        return value
    raise wrong(f"executor.{key}", value, "null or a name without spaces")


def _extra(given: Mapping[str, object]) -> Iterator[tuple[str, str | None]]:
    for name, value in given.items():
        key = f"executor.options.{name}"
        if not _NAME.fullmatch(name):
            raise wrong(key, value, "a long name of an option of sbatch, such as qos,")
        own = next((one for one in _OWN if one.startswith(name)), None)
        if own is not None:
            raise LaunchError(f"{key} is {value!r}, but {_OWN[own].format(own)}: remove {key}.")
        if value is None or value is True:
            yield name, None
        elif value is not False and isinstance(value, str | int | float) and "\n" not in str(value):
            yield name, str(value)
        else:
            raise wrong(key, value, "a text, a number, or true for an option without a value")


def _quoted(value: str) -> str:
    """Return a value as ``sbatch`` reads it in a script."""
    if re.fullmatch(r"[\w.,:;@%/=&|*+-]+", value):
        return value
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


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
