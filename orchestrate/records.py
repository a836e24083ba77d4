"""Records of a run and of its failure, shared by the executors and the results database.

The module imports the standard library only: every worker process loads it.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

URL_VARIABLE = "DOPT_DB"
"""Environment variable that names another default database; an empty one counts as unset."""

ENVIRONMENT = "environment"
"""Cause of a failure that is not the trial's: the launch ends, and the trial waits."""


@dataclass(frozen=True)
class RunRecord:
    """Place, time and resources of one attempt at a trial.

    Attributes
    ----------
    node, pid
        Host name and process number.
    wall_seconds, cpu_seconds
        Duration and processor time.
    peak_memory_bytes
        Largest resident memory of the process so far.
    started, ended
        Times with a time zone.
    """

    node: str
    pid: int
    wall_seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    started: datetime
    ended: datetime


@dataclass(frozen=True)
class Failure:
    """Reason why an attempt failed.

    Attributes
    ----------
    type, message, traceback
        Name of the exception class, its message, and the stack where it was raised.
    cause
        "exception", "timeout", "out of memory", "killed", "node lost", "malformed", ENVIRONMENT.
    """

    type: str
    message: str
    traceback: str
    cause: str = "exception"
