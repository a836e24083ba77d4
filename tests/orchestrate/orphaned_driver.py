"""A driver on Ray whose parent is process 1, as after ``setsid``; its raylet is killed.

``python -m tests.orchestrate.orphaned_driver PID`` waits for the end of its parent, whose process
id is given. It prints what it lives to see: the new parent, the error, and its own end.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import time
from typing import Any

from orchestrate.errors import InfrastructureError
from orchestrate.executors.ray.executor import RayExecutor  # before Ray itself, as in a launch
from tests.orchestrate.executors.test_executors import drain, tasks
from tests.orchestrate.lean_ray import leave_services_out
from tests.orchestrate.standins import slow


def _drive() -> None:
    _say(f"parent {os.getppid()}")
    leave_services_out()
    executor = RayExecutor(slow, workers=1)
    executor.start()
    import ray

    node: Any = ray._private.worker._global_node
    executor.submit(tasks(range(20)))
    os.kill(node.all_processes["raylet"][0].process.pid, signal.SIGKILL)
    try:
        drain(executor)
    except InfrastructureError as error:
        _say(str(error))
    executor.stop()
    _say(f"processes of Ray: {sum(1 for _ in node.live_processes())}")


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    while os.getppid() == int(sys.argv[1]):
        time.sleep(0.01)
    atexit.register(_say, "exit")
    _drive()
