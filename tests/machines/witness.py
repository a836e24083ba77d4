"""``launch.py`` whose workers leave notes in HOME of what they begin and finish.

So a test can see that a worker went on, whose outcome never arrived. Between computing and
finishing a trial they wait for WITNESS_PAUSE seconds, or, with WITNESS_HOLD, until the test lets
the host go on.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from dopt.kernel import compiling
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from orchestrate import launch
from orchestrate.runner import start
from orchestrate.runner.start import Work

PAUSE = "WITNESS_PAUSE"
HOLD = "WITNESS_HOLD"
_GO = "go"


def witnessed(spec: TrialSpec) -> TrialResult:
    _note("begun", spec.seed)
    result = run_trial(spec)
    while HOLD in os.environ and not (Path.home() / _GO).exists():
        time.sleep(0.05)
    time.sleep(float(os.environ.get(PAUSE, "0")))
    _note("finished", spec.seed)
    return result


def _note(kind: str, seed: int) -> None:
    with (Path.home() / kind).open("a") as notes:
        notes.write(f"{seed} {time.time()}\n")


def let_go(home: Path) -> None:
    """Let the trials of a host end that are started with WITNESS_HOLD."""
    (home / _GO).touch()


def read_notes(home: Path, kind: str) -> dict[int, float]:
    """Return the trials that a host has begun or finished, and when, in seconds since 1970."""
    path = home / kind
    lines = path.read_text().splitlines() if path.exists() else []
    return {int(seed): float(moment) for seed, moment in (line.split() for line in lines)}


if __name__ == "__main__":
    from tests.machines.witness import witnessed as importable  # by a name that workers know

    start.WORK = Work(importable, compiling)
    sys.exit(launch.main())
