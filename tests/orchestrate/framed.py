"""Program in the frame of all programs, which does what its first word says."""

from __future__ import annotations

import os
import sys
import time
import warnings

from orchestrate.program import run
from orchestrate.runner.progress import Interrupt

LETTERS = "0 · ± 2 °C, m/s², 10⁻¹², θ̇ ≤ γ, Ω, é, 東"


def main() -> int:
    """Do one thing, and return its exit code."""
    word = sys.argv[1]
    if word == "wait":
        with Interrupt() as stop:
            print("ready", flush=True)  # noqa: T201
            while not stop.stop_requested:
                time.sleep(0.01)
        return 5
    if word == "warn":
        warnings.warn("a library is old", DeprecationWarning, stacklevel=1)
        warnings.warn("and leaks", ResourceWarning, stacklevel=1)
        return 5
    if word == "open":
        with open(sys.argv[2], "w") as file:  # noqa: PTH123
            sys.stdout.write("said")
            sys.stderr.write("said")
            file.write(str(file.fileno()))
        return 5
    if word == "child":
        return os.waitstatus_to_exitcode(os.system("read line || exit 5"))
    sys.stdout.write(LETTERS)
    sys.stderr.write(f"{LETTERS}\n")
    return 5


if __name__ == "__main__":
    run("tests.orchestrate.framed")
