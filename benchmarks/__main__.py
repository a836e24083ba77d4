"""``python -m benchmarks [--only step,store] [--quick]``: one table of measured speed."""

from __future__ import annotations

from orchestrate.executors.limits import pin_threads
from orchestrate.program import run

if __name__ == "__main__":
    pin_threads()  # the libraries read the pins when imported
    run("benchmarks.cli")
