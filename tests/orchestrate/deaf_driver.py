"""A driver whose one worker hears nothing; it prints the worker's process id, and waits.

``python -m tests.orchestrate.deaf_driver``
"""

from __future__ import annotations

import sys

from orchestrate.executors.local import LocalExecutor
from tests.orchestrate.executors.test_executors import tasks
from tests.orchestrate.standins import BROKEN_SEED
from tests.orchestrate.unruly import deaf

if __name__ == "__main__":
    with LocalExecutor(deaf, workers=1) as executor:
        executor.submit(tasks([0, BROKEN_SEED]))
        while not executor.wait(60.0):
            continue
        sys.stdout.write(f"{executor._workers[0].process.pid}\n")
        sys.stdout.flush()
        sys.stdin.read()
