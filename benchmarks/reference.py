"""Speed of the torch reference, one trial at a time and a hundred in lockstep."""

from __future__ import annotations

from benchmarks import anchors
from benchmarks.rows import Row
from benchmarks.trials import cartpole
from dopt.result import TrialResult

BATCH = 100
GPU_BATCHES = (BATCH, 4_096)
SKIPPED = 14
"""First steps of a batch, in which torch allocates and operations are recorded."""

SETTLED = 160
"""Steps of one trial: the window is full after 100, and its gradient recorded soon after."""


def measure(quick: bool) -> list[Row]:
    """Return the cost of a step for each trial of a batch, and trial-steps per second."""
    import torch

    rows = _rows(1, SETTLED)
    if not quick:
        rows += _rows(BATCH, SKIPPED + 10)
    if not quick and torch.cuda.is_available():
        rows += [row for size in GPU_BATCHES for row in _rows(size, SETTLED, "cuda")]
    return rows


def _rows(size: int, steps: int, device: str = "cpu") -> list[Row]:
    from dopt.reference.batch import run_trials

    specs = [cartpole(seed=seed, horizon=steps) for seed in range(size)]
    result = run_trials(specs, device)[0]
    plan, learn, evaluation = _settled(result)
    what = f"torch, {f'{size} trials in lockstep' if size > 1 else 'one trial'} on {device}"
    known = anchors.LOCKSTEP if size == BATCH and device == "cpu" else None
    note = f"{min(steps, 100)} samples in the window"
    return [
        Row(what, plan + learn, "µs a step", anchor=known, note=note),
        Row(f"{what}, planned and informed", 1e6 / plan, "trial-steps/s"),
        Row(f"{what}, evaluated", 1e6 / (plan + learn + evaluation), "trial-steps/s"),
    ]


def _settled(result: TrialResult) -> list[float]:
    """Return microseconds for one trial of the batch: to plan and inform, to learn, to evaluate."""
    last = slice(max(SKIPPED, len(result.loss) - 20), None)
    parts = result.plan_us, result.learn_us, result.evaluate_us
    return [float(part[last].mean()) for part in parts]
