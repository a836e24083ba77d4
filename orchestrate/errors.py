"""What can go wrong around the trials, and the exit code of each kind."""

from __future__ import annotations

import enum

from dopt.errors import DoptError


class ExitCode(enum.IntEnum):
    """What a launch tells the shell."""

    DONE = 0
    SOME_FAILED = 1
    BAD_REQUEST = 2
    DEFECT = 70  # of the program itself, with a traceback
    INFRASTRUCTURE = 75
    INTERRUPTED = 130


class LaunchError(DoptError, ValueError):
    """A setting of the launch is wrong; nothing was run."""


class InfrastructureError(DoptError):
    """Something below the trials was lost, such as Ray; the same command goes on later."""
