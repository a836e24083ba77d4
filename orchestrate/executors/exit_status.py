"""Exit status of a dead worker process: crash report, signal, and kernel memory kills."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from signal import SIGKILL

_KERNEL_COUNTERS = Path("/proc/vmstat")


@dataclass(frozen=True)
class ExitStatus:
    """Description, cause and last stack of a process that has ended."""

    reason: str
    cause: str
    traceback: str


class CrashReport:
    """Anonymous file to which ``faulthandler`` writes the stack of a dying process."""

    def __init__(self) -> None:
        self.descriptor = os.memfd_create("crash report")
        self._kills = _kills_for_memory()

    def explain(self, code: int) -> ExitStatus:
        """Return the status for an exit code, negative for a signal; close the file."""
        stack = Path(f"/proc/self/fd/{self.descriptor}").read_text(errors="replace")
        self.close()
        if code == -SIGKILL and _kills_for_memory() > self._kills:
            return ExitStatus("killed by the kernel: out of memory", "out of memory", stack)
        if stack.startswith("Timeout"):  # written by faulthandler
            return ExitStatus("killed: it ignored its time limit", "timeout", stack)
        reason = f"killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return ExitStatus(reason, "killed", stack)

    def close(self) -> None:
        """Close the file, which deletes it."""
        os.close(self.descriptor)


def _kills_for_memory() -> int:
    """Return the number of processes killed by the kernel for lack of memory; 0 if unknown."""
    try:
        lines = _KERNEL_COUNTERS.read_text().splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in lines if line.startswith("oom_kill "))
