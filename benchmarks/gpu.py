"""Batches of D-optimal trials in torch, on a GPU where there is one: ``python -m benchmarks.gpu``.

Inputs are compared with the CPU's and the kernel's; trial-steps a second by the size of the batch
stand beside the rate of the device's memory. No batch begins after ``--seconds``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch

from benchmarks.rows import Row, show
from benchmarks.trials import CYCLE, TINY_GRID, WINDOW, cartpole, cost, run_in_turn, step_us
from dopt.reference.batch import Lockstep
from dopt.reference.models import planning_columns
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.types import Array

EQUAL, COMPARED = 1e-8, 50
"""Largest difference of inputs that are equal, and the steps over which they are compared."""

TIE = 1e-12  # cosine of g and D B in M⁻¹ below which rounding decides about a sign
SIZES = {"cuda": (100, 400, 1_600, 4_096, 16_384), "cpu": (4, 16)}
STEPS = {"cuda": WINDOW + CYCLE, "cpu": 2 * CYCLE}
COPIED = {"cuda": 2**27, "cpu": 2**24}  # numbers: more than a cache holds


def measure(device: str, seconds: float) -> Iterator[Row]:
    """Measure a device for so many seconds, and yield each row as it is there."""
    end, kind = time.perf_counter() + seconds, device.partition(":")[0]
    for env in ("cartpole", "arm"):
        yield compare(env, device, SIZES[kind][0])
    rate = memory_rate(device, COPIED[kind])
    yield Row(f"memory of {device}", rate / 1e9, "GB/s", note="read and written by a copy")
    results, _ = run_in_turn({"one": cartpole(grid=TINY_GRID)}, rounds=2)
    whole = cost(results["one"], lambda result: step_us(result) + result.evaluate_us).mean
    yield Row("kernel on one core", 1e6 / whole, "trial-steps/s")
    for size in SIZES[kind]:
        what = f"{size:,} trials on {device}"
        if time.perf_counter() >= end:
            yield Row(what, None, note="the time was over: give more --seconds")
            continue
        try:
            yield speed(what, device, size, STEPS[kind], rate)
        except torch.OutOfMemoryError:
            yield Row(what, None, note="the memory of the device is too small")


def compare(env: str, device: str, trials: int) -> Row:
    """Compare the inputs of the first steps on a device with the CPU's and the kernel's."""
    first = TrialSpec.from_names(env={"name": env, "horizon": COMPARED}, policy="d_optimal", seed=0)
    specs = [first.with_seed(seed) for seed in range(trials)]
    inputs = {"kernel": np.stack([run_trial(spec).inputs for spec in specs])}
    for one in {device, "cpu"}:
        inputs[one] = _advanced(Lockstep(specs, one), 0, COMPARED).inputs.cpu().numpy()
    there = inputs.pop(device)
    found = {other: largest_difference(specs, there, given) for other, given in inputs.items()}
    note = "; ".join(f"{other}: {worst:.1g}{ties}" for other, (worst, ties) in found.items())
    what = f"{env}, {trials} trials, {COMPARED} steps on {device}, largest difference of an input"
    return Row(what, max(worst for worst, _ in found.values()), note=note)


def largest_difference(specs: Sequence[TrialSpec], one: Array, other: Array) -> tuple[float, str]:
    """Return the largest difference of inputs, (n, T, m), before ties part, and where they do."""
    worst, ties = 0.0, ""
    for spec, a, b in zip(specs, one, other, strict=True):
        apart = np.nan_to_num(np.abs(a - b).max(axis=1), nan=np.inf)
        first = int(np.argmax(apart > EQUAL))
        if apart[first] > EQUAL and spec.system.n_inputs == 1 and cosine(spec, first) < TIE:
            apart, ties = apart[:first], f"{ties}, a tie at step {first} of seed {spec.seed}"
        worst = max(worst, *apart, 0.0)
    return worst, ties


@torch.no_grad()
def cosine(spec: TrialSpec, t: int) -> float:
    """Return the cosine of the angle between g and D B in M⁻¹ at step t of a trial on the CPU."""
    batch = _advanced(Lockstep([spec]), 0, t)
    x, k = batch.states[:, t], batch.components[:, t]
    columns = planning_columns(batch.system, batch.model, batch.theta, x, k)
    assert batch.information is not None
    forms = (columns @ batch.information.solve(columns.mT))[0]
    return abs(float(forms[0, 1] / (forms[0, 0] * forms[1, 1]).sqrt()))


@torch.no_grad()
def _advanced(batch: Lockstep, first: int, last: int) -> Lockstep:
    for t in range(first, last):
        batch.step(t)
    return batch


def _seconds(device: str, work: Callable[[], object]) -> float:
    wait = torch.cuda.synchronize if device != "cpu" else lambda _: None
    wait(device)
    start = time.perf_counter()
    work()
    wait(device)
    return time.perf_counter() - start


def memory_rate(device: str, numbers: int) -> float:
    source = torch.ones(numbers, dtype=torch.float64, device=device)
    target = torch.empty_like(source)
    return 2 * source.nbytes / min(_seconds(device, lambda: target.copy_(source)) for _ in range(5))


@torch.no_grad()
def speed(what: str, device: str, size: int, steps: int, rate: float) -> Row:
    """Return the trial-steps a second of a batch in its last steps, and how M uses the memory.

    Of each trial q² numbers count as read and written. M⁻¹ is read twice: the bound is two thirds.
    """
    spec = cartpole(horizon=steps, grid=TINY_GRID)
    batch = Lockstep([spec.with_seed(seed) for seed in range(size)], device)
    _advanced(batch, 0, steps - CYCLE)
    taken = _seconds(device, lambda: _advanced(batch, steps - CYCLE, steps))
    information, theta = batch.information, batch.theta
    assert information is not None
    rows = torch.full((size, batch.system.n_learned, theta.shape[1]), 1e-3).to(theta)
    update = min(_seconds(device, lambda: information.add(rows)) for _ in range(3))
    share = 2 * 8 * theta.shape[1] ** 2 * size / update / rate
    note = f"M takes {update * CYCLE / taken:.0%} of a step, {share:.0%} of the memory's rate"
    return Row(what, size * CYCLE / taken, "trial-steps/s", note=note)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the rows; 1 if inputs differ, or the device is not there."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1 or cpu (default: cuda)")
    parser.add_argument("--seconds", type=float, default=600.0, help="(default: %(default)g)")
    given = parser.parse_args(arguments)
    cards = [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    here = ["cpu", "cuda", *cards] if cards else ["cpu"]
    if given.device not in here:
        known, hint = " and ".join(here), "give one of them; cpu takes small batches"
        sys.stderr.write(f"--device is '{given.device}', but torch runs here on {known}: {hint}.\n")
        return 1
    rows = show(measure(given.device, given.seconds))
    return int(any((row.value or 0.0) > EQUAL for row in rows if "difference" in row.what))


if __name__ == "__main__":
    sys.exit(main())
