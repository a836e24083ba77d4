"""Times of explorations at 200 Hz: ``python -m studies.speed.real_time [--seconds 60] [--busy]``.

A simulated disk is asked and told at its ticks, while fits run beside; with ``--busy`` another
process computes all the time as well. With ``--urgent`` the exploration runs before all others, as
by ``chrt --fifo 1``.
"""

from __future__ import annotations

import argparse
import gc
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from tabulate import tabulate

from dopt import Explorer, Plant
from dopt.types import Array

DT = 0.005  # s
DISK = Plant(
    states={"angle": "rad", "rate": "rad/s"},
    inputs={"voltage": "V"},
    dt=DT,
    gamma=6.0,
    known={"angle": "rate", "rate": "gain * voltage"},
    constants={"gain": 40.0},
    learned=["rate"],
    angles=["angle"],
    box={"rate": 30.0},
)
EVIDENCE = {"name": "gaussian_process", "hyperparameters": "evidence"}
LEARNERS: Mapping[str, Mapping[str, Any]] = {
    "adam_window": {},
    "gauss_newton": {"learner": {"name": "gauss_newton", "refit_every": 0}},
    "evidence": {"policy": "exact", "model": EVIDENCE, "learner": "conditioning"},
    "simulation_error": {"learner": "simulation_error"},
}


def moved(x: Array, u: float, noise: Callable[[], Array]) -> Array:
    """Return the state after a period: gravity, viscous and dry friction, an encoder's noise."""
    angle, rate = x
    for _ in range(10):
        torque = 40.0 * u - 90.0 * np.sin(angle) - 3.0 * rate - 5.0 * np.tanh(rate / 0.1)
        rate += 0.1 * DT * torque
        angle += 0.1 * DT * rate
    return np.array([angle, rate]) + noise()


def run(seconds: float, parts: Mapping[str, Any]) -> tuple[Array, Explorer]:
    """Return the seconds of each ask and tell, (T, 2), and the exploration."""
    rng, steps = np.random.default_rng(0), int(seconds / DT)
    times = np.empty((steps, 2))
    with Explorer(DISK, steps=steps, seed=1, deadline=0.8 * DT, **parts) as explorer:
        x = np.zeros(2)
        explorer.ask(x)
        gc.freeze()  # what has been imported is not looked at again
        tick = time.monotonic()
        for t in range(steps):
            tick += DT
            time.sleep(max(0.0, tick - time.monotonic()))
            began = time.perf_counter()
            u = explorer.ask(x)
            asked = time.perf_counter()
            x = moved(x, float(u[0]), lambda: 1e-4 * rng.standard_normal(2))
            told = time.perf_counter()
            explorer.tell(x)
            times[t] = asked - began, time.perf_counter() - told
        return times, explorer


@contextmanager
def busy(wanted: bool) -> Iterator[None]:
    """Let another process compute while the block runs."""
    if not wanted:
        yield
        return
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as process:
        try:
            yield
        finally:
            process.kill()


def schedule(policy: int) -> None:
    """Let this process, and threads that it begins, be scheduled by a policy of Linux."""
    os.sched_setscheduler(0, policy, os.sched_param(int(policy == os.SCHED_FIFO)))


def main() -> None:
    """Print the times of each learner."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--busy", action="store_true", help="beside a process that computes")
    parser.add_argument("--urgent", action="store_true", help="as by chrt --fifo 1")
    parser.add_argument("--learner", choices=LEARNERS, nargs="*", default=[*LEARNERS])
    given = parser.parse_args()
    heads = [f"{what} {at}" for what in ("ask", "tell") for at in ("p50", "p99", "max")]
    rows = []
    for name in given.learner:
        with busy(given.busy):
            schedule(os.SCHED_FIFO if given.urgent else os.SCHED_OTHER)
            times, explorer = run(given.seconds, LEARNERS[name])
            schedule(os.SCHED_OTHER)
        columns = 1e3 * np.quantile(times, [0.5, 0.99, 1.0], axis=0).T
        both = 1e3 * np.quantile(times.sum(axis=1), 0.99)
        counts = explorer.counts["missed"], explorer.counts["refits"]
        rows.append([name, *columns.ravel(), both, *counts])
    heads = ["learner [ms]", *heads, "both p99", "missed", "refits"]
    sys.stdout.write(f"{tabulate(rows, heads, floatfmt='.2f')}\n")


if __name__ == "__main__":
    main()
