"""How a worker process ended: what it still said, and what the kernel knows."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from signal import SIGKILL

_COUNTS = Path("/proc/vmstat")


@dataclass(frozen=True)
class Ending:
    """The end of a process: a few words, its kind, and where the process was as far as known."""

    reason: str
    cause: str
    traceback: str


class LastWords:
    """A file without a name, in which a process leaves where it was when it ended by force."""

    def __init__(self) -> None:
        self.descriptor = os.memfd_create("last words")
        self._kills = _kills_for_memory()

    def explain(self, code: int) -> Ending:
        """Say how a process ended whose exit code is ``code``, negative for a signal."""
        said = Path(f"/proc/self/fd/{self.descriptor}").read_text(errors="replace")
        self.close()
        if code == -SIGKILL and _kills_for_memory() > self._kills:
            return Ending("been killed by the kernel for want of memory", "out of memory", said)
        if said.startswith("Timeout"):  # faulthandler's word
            return Ending("not heeded its limit of time", "timeout", said)
        reason = f"been killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return Ending(reason, "killed", said)

    def close(self) -> None:
        """Forget what is in the file."""
        os.close(self.descriptor)


def _kills_for_memory() -> int:
    """Return how many processes the kernel has killed for want of memory, 0 where it is unknown."""
    try:
        lines = _COUNTS.read_text().splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in lines if line.startswith("oom_kill "))
