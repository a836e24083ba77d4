"""Time and memory of long and wide trials, and what a step costs by each of its sizes.

``python -m studies.speed.scaling > docs/scaling.csv`` writes what the page prints; with names of
:data:`MEASUREMENTS` only these. Each is a process of its own, whose memory is the trial's. Times
are the processor's; a step is planned, simulated, learned and added to M, and not evaluated.
"""

from __future__ import annotations

import csv
import functools
import os
import sys
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from benchmarks import processes
from benchmarks.trials import CYCLE
from dopt.kernel.from_spec import shared_points
from dopt.kernel.loop import act_next, evaluate_next
from dopt.kernel.pointers import compiled_step
from dopt.kernel.run import KernelSteps
from dopt.spec.trial import TrialSpec

SYSTEMS: dict[str, dict[str, object]] = {
    "cartpole": {"grid_points": [16, 32, 16]},
    "drone": {"state_limit": 1e6},  # it flies tens of kilometres
    # The chain of env=beyond/chain as long and as heavy as it is there, of shorter links.
    # Its fastest modes take steps of Runge and Kutta.
    "chain": {"length": 0.1, "mass": 0.05, "friction": 0.02, "gamma": 0.2}
    | {"dt": 0.01, "integrator": "rk4"},
}
SETTLED, SECTIONS = 16, 5
"""Steps before the sections of :data:`CYCLE` steps that are measured; the quickest counts."""


class Row(NamedTuple):
    """A line of the file; memory [MiB]: the process's largest so far, rows of the record."""

    trial: str
    form: str
    parameters: int
    steps: int
    against: str
    size: int
    step_us: float
    peak: float
    rows: float


class Steps(KernelSteps):
    """A simulated trial that is advanced without an evaluation."""

    also_called = (act_next,)

    def __init__(
        self, env: str, width: int, steps: int, form: str, learner: str = "adam", links: int = 20
    ) -> None:
        system = {"name": env, "horizon": steps, **SYSTEMS[env]}
        system |= {"n_links": links} if env == "chain" else {}
        policy, model = {"name": "d_optimal", "form": form}, {"name": "mlp", "width": width}
        parts = {"env": system, "policy": policy, "model": model, "learner": {"name": learner}}
        super().__init__(TrialSpec.from_mapping({**parts, "seed": 0}))
        self.about = f"{env}, width {width:,}", form, len(self.state.theta), steps

    def advance(self, last: int) -> float:
        """Return microseconds of the processor for each step from the present one to ``last``."""
        start, first, dt = time.thread_time(), self.done, self.spec.system.dt
        for t in range(first, last):
            self.plan_input(t)
            if not (self.call(act_next, t) and self.take_in(t, dt)):
                raise RuntimeError(f"{self.about[0]} diverged at step {t}: choose weaker inputs.")
        self.done = last
        return 1e6 * (time.thread_time() - start) / (last - first)

    def quickest(self) -> float:
        """Return microseconds of a step in the quickest section of those that follow."""
        self.advance(self.done + SETTLED)
        return min(self.advance(self.done + CYCLE) for _ in range(SECTIONS))

    def row(self, against: str, size: int, step_us: float) -> Row:
        peak = processes.peak_mebibytes(os.getpid(), float("nan"))
        written = sum(rows[: self.done].nbytes for rows in self.record) / 2**20
        return Row(*self.about, against, size, step_us, peak, written)


def tenths(env: str, width: int, steps: int, form: str, learner: str) -> Iterator[Row]:
    """Measure each tenth of a long trial."""
    trial = Steps(env, width, steps, form, learner)
    for tenth in range(1, 11):
        yield trial.row("tenth", tenth, trial.advance(tenth * steps // 10))


def parameters(form: str, *widths: int) -> Iterator[Row]:
    """Measure a step by the width of the network; with the dual form after 400 others."""
    for width in widths:
        trial = Steps("cartpole", width, 500, form)
        if form == "dual":
            trial.advance(400)
        yield trial.row("q", trial.about[2], trial.quickest())


def horizons(form: str) -> Iterator[Row]:
    """Measure the mean step of trials by their length, which are the beginnings of the longest."""
    trial, total = Steps("cartpole", 16, 2_000, form), 0.0
    for end in (125, 250, 500, 1_000, 2_000):
        total += (end - trial.done) * trial.advance(end)
        yield trial.row("T", end, total / end)


def dimensions(*links: int) -> Iterator[Row]:
    """Measure a step of the chain by the dimensions of its state."""
    for n in links:
        trial = Steps("chain", 64, 200, "sketch", links=n)
        yield trial.row("d", 2 * n, trial.quickest())


def points(*blocks: int) -> Iterator[Row]:
    """Measure an evaluation by its number of points."""
    trial = Steps("cartpole", 64, 10, "sketch")
    whole = shared_points(trial.spec.config)
    evaluate = compiled_step(trial.trial, evaluate_next, whole)
    for n in blocks:
        some, taken = whole._replace(bounds=np.array([0, n, n])), []
        for _ in range(SECTIONS):
            start = time.thread_time()
            evaluate(trial.held, some, 0)
            taken.append(1e6 * (time.thread_time() - start))
        yield trial.row("N", int(whole.block_sizes[:n].sum()), min(taken))


WIDE = 64, 128, 256, 512, 1024
MEASUREMENTS: dict[str, Callable[[], Iterator[Row]]] = {
    "cartpole": functools.partial(tenths, "cartpole", 64, 100_000, "sketch", "adam_window"),
    "q_primal": functools.partial(parameters, "primal", 16, 24, 32, 48, 64),
    "q_dual": functools.partial(parameters, "dual", *WIDE),
    "q_sketch": functools.partial(parameters, "sketch", *WIDE),
    "T_primal": functools.partial(horizons, "primal"),
    "T_dual": functools.partial(horizons, "dual"),
    "T_sketch": functools.partial(horizons, "sketch"),
    "d": functools.partial(dimensions, 2, 4, 8, 16, 20),
    "N": functools.partial(points, 1, 2, 4, 8, 16, 32),
    "chain": functools.partial(tenths, "chain", 64, 100_000, "sketch", "adam_window"),
    "exact": functools.partial(tenths, "cartpole", 64, 2_000, "primal", "adam_window"),
    "wide": functools.partial(tenths, "cartpole", 1024, 100_000, "sketch", "adam"),
    "drone": functools.partial(tenths, "drone", 64, 100_000, "sketch", "adam_window"),
}


if __name__ == "__main__":
    if len(sys.argv) == 2:
        table = csv.writer(sys.stdout, lineterminator="\n")
        for row in MEASUREMENTS[sys.argv[1]]():
            table.writerow(f"{cell:.1f}" if isinstance(cell, float) else cell for cell in row)
            sys.stdout.flush()
    else:
        sys.stdout.write(",".join(Row._fields) + "\n")
        for name in sys.argv[1:] or MEASUREMENTS:
            sys.stdout.write(processes.run("-m", "studies.speed.scaling", name).output)
            sys.stdout.flush()
