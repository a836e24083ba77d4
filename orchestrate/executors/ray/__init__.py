"""Executor on Ray: one machine or a cluster."""

import os
import sys

if "ray" not in sys.modules:
    # Ray reads this when it is first imported. A driver without it takes its raylet for dead if the
    # parent of the driver is process 1, as after setsid or in a container, and is ended with no
    # exception when a call to a dead raylet fails. The raylet gives its own number to workers.
    os.environ["RAY_RAYLET_PID"] = str(os.getpid())
