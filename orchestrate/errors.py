"""Errors of a launch, and exit codes."""

from __future__ import annotations

import enum

from dopt.errors import DoptError


class ExitCode(enum.IntEnum):
    """Exit codes of the programs."""

    DONE = 0
    SOME_FAILED = 1
    BAD_REQUEST = 2
    UNFINISHED = 3  # trials are left, for which another worker may be started
    DEFECT = 70  # a bug of the program, with a traceback
    INFRASTRUCTURE = 75
    INTERRUPTED = 130


class LaunchError(DoptError, ValueError):
    """Invalid setting of a launch; nothing was run."""


class InfrastructureError(DoptError):
    """Loss of a service such as Ray; the same command continues later."""
