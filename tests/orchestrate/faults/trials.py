"""Short trials whose numbers depend on the trial alone, and the gate that they pass one by one."""

from __future__ import annotations

import dataclasses
import os
import select
import signal
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dopt.result import Assessment, TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid
from orchestrate.executors.base import Run
from tests.orchestrate.standins import diverged, quick, specification

_DIGITS = 8


@dataclass(frozen=True)
class Gate:
    """A gate at which trials of all processes arrive, in a folder; it is open at first.

    A launch with a closed gate cannot end before the fault comes, however late that is.
    """

    folder: Path

    def let(self, more: int) -> None:
        """Let those that wait, and so many that come later, pass, and close the gate then."""
        self._set_limit(len(self._arrived()) + more)

    def open(self) -> None:
        self._set_limit(sys.maxsize)

    def waiting(self) -> list[int]:
        """Return the processes whose trials have come to the closed gate, the first one first."""
        return self._arrived()[self._limit() :]

    @property
    def passed(self) -> int:
        """Number of trials that have passed."""
        return min(len(self._arrived()), self._limit())

    def pass_through(self) -> None:
        """Wait, as a trial, until the gate is open."""
        number = self._arrive()
        while number >= self._limit():
            rest(0.02)

    def _arrive(self) -> int:
        """Leave the number of this process, and return how many came before."""
        file = os.open(self.folder / "arrived", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            os.write(file, f"{os.getpid():{_DIGITS}d}".encode())
            return os.lseek(file, 0, os.SEEK_CUR) // _DIGITS - 1
        finally:
            os.close(file)

    def _arrived(self) -> list[int]:
        path = self.folder / "arrived"
        text = path.read_text() if path.exists() else ""
        return [int(text[i : i + _DIGITS]) for i in range(0, len(text), _DIGITS)]

    def _limit(self) -> int:
        path = self.folder / "limit"
        return int(path.read_text()) if path.exists() else sys.maxsize

    def _set_limit(self, limit: int) -> None:
        new = self.folder / "new limit"
        new.write_text(str(limit))
        new.replace(self.folder / "limit")


@dataclass(frozen=True)
class Gated:
    """A run of trials, each of which passes a gate first."""

    run: Run
    gate: Gate

    def __call__(self, spec: TrialSpec) -> TrialResult:
        self.gate.pass_through()
        return self.run(spec)


def rest(seconds: float) -> None:
    """Sleep, also under libfaketime 0.9, which makes an error of every ``time.sleep``."""
    select.select([], [], [], seconds)


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
