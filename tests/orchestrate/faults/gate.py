"""The clock of the faults: trials that pass one by one, as many as a test lets."""

from __future__ import annotations

import os
import select
import sys
from dataclasses import dataclass
from pathlib import Path

from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.executors.base import Run

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
