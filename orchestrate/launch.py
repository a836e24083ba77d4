"""Entry point of a launch: ``python orchestrate/launch.py [-m] [key=value ...]``.

Hydra composes the command line in :mod:`orchestrate.config`; the rest uses plain types.
"""

from __future__ import annotations

import sys
from pathlib import Path

if __package__ in (None, ""):
    # Python puts a script's own folder first; the packages are in the folder above it.
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from dopt.garbage_collection import collect_rarely
from orchestrate.executors.worker_environment import pin_threads

pin_threads()
collect_rarely()

from orchestrate.errors import ExitCode  # noqa: E402
from orchestrate.runner.launch import main  # noqa: E402


def program() -> None:
    """Run the command line as a program of its own: ``dopt-launch``."""
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(ExitCode.INTERRUPTED)


if __name__ == "__main__":
    program()
