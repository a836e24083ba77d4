"""Short trials whose numbers depend on nothing but the trial, one of them broken if asked."""

from __future__ import annotations

import dataclasses
import os
import signal
from dataclasses import dataclass

import numpy as np

from dopt.result import Assessment, TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid
from tests.orchestrate.faults.gate import rest
from tests.orchestrate.standins import diverged, quick, specification

BROKEN_SEED = 7
DIVERGING = 5
"""Each trial whose seed is divisible by it diverges."""

HORIZON = 8
MEBIBYTE = 2**20


@dataclass(frozen=True)
class Standin:
    """A run of ``seconds``; ``trouble`` is what the trial with the broken seed does besides.

    "kill" ends its process, "kill worker" the one that started it, "hang" never returns, "memory"
    takes more and more memory.
    """

    seconds: float
    trouble: str = ""

    def __call__(self, spec: TrialSpec) -> TrialResult:
        rest(self.seconds)
        if self.trouble and spec.seed == BROKEN_SEED:
            _TROUBLES[self.trouble]()
        return outcome(spec)


def outcome(spec: TrialSpec) -> TrialResult:
    """Return the numbers of a trial, assessed on the way; every fifth one diverges."""
    result = diverged(spec, at=3) if spec.seed % DIVERGING == 0 else quick(spec)
    rows = [Assessment(t, "cost", spec.seed + t / 8) for t in (0, 1, 3)]
    return dataclasses.replace(result, assessments=tuple(rows))


def grid_of(trials: int) -> Grid:
    """Return trials that differ in their seed, from 0 on."""
    first = specification(0, horizon=HORIZON)
    seeds = [first.with_seed(seed) for seed in range(trials)]
    return Grid(seeds, n_jobs=trials, left_out={})


def _kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _kill_worker() -> None:
    os.kill(os.getppid(), signal.SIGKILL)
    rest(3600)


def _hang() -> None:
    rest(3600)


def _take_memory() -> None:
    """Take memory that is really there, 64 MiB at a time, up to 8 GiB."""
    taken = []
    for _ in range(128):
        taken.append(np.ones(8 * MEBIBYTE))
        rest(0.01)


_TROUBLES = {"kill": _kill, "kill worker": _kill_worker, "hang": _hang, "memory": _take_memory}
