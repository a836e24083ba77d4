"""Entry point of a launch: ``python orchestrate/launch.py [-m] [key=value ...]``.

Hydra composes the command line in :mod:`orchestrate.config`; the rest uses plain types.
"""

from __future__ import annotations

import sys
from pathlib import Path

if __package__ in (None, ""):
    # Python puts a script's own folder first; the packages are in the folder above it.
    sys.path[: not sys.flags.safe_path] = [str(Path(__file__).resolve().parents[1])]

from dopt.process import collect_rarely
from orchestrate.executors.limits import pin_threads
from orchestrate.program import run


def program() -> None:
    """Run the command line as a program of its own: ``dopt-launch``."""
    pin_threads()
    collect_rarely()
    run("orchestrate.runner.launch")


if __name__ == "__main__":
    program()
