"""``python -m benchmarks [--only step,store] [--quick]``: one table of measured speed."""

from __future__ import annotations

import sys

from orchestrate.executors.worker_environment import pin_threads

pin_threads()

from benchmarks.cli import main  # noqa: E402  # the libraries read the pins when imported

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
