"""Settings of ``executor=slurm`` as checked values, and the options of ``sbatch`` for them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dopt.errors import DoptError
from dopt.given_path import given_path
from orchestrate.cli_parser import length_of_time
from orchestrate.config.value_checks import count, limit, section, text, wrong
from orchestrate.errors import LaunchError

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
