"""Stand-ins for ``run_trial``: quick, slow, and broken in one way each."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence

import numpy as np

from dopt.errors import UnusableEnvironmentError
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid

BROKEN_SEED = 2


def specification(seed: int = 0, **env: object) -> TrialSpec:
    """Return a short trial of the pendulum."""
    section, model = {"name": "pendulum", "horizon": 5, **env}, {"name": "mlp", "width": 2}
    return TrialSpec.from_names(section, "random", model=model, learner="adam", seed=seed)


def quick(spec: TrialSpec) -> TrialResult:
    """Return numbers that only depend on the trial."""
    rng = np.random.default_rng(int(spec.trial_key[:12], 16))
    steps = spec.system.horizon
    return TrialResult(
        loss=rng.random(steps),
        reachable_loss=rng.random(steps),
        plan_us=np.ones(steps),
        learn_us=np.ones(steps),
        evaluate_us=np.ones(steps),
        states=rng.random((steps + 1, 2)),
        inputs=rng.random((steps, 1)),
        parameters=rng.random(7),
        diverged_at=None,
        wall_seconds=0.0,
        cpu_seconds=0.0,
    )


def slow(spec: TrialSpec) -> TrialResult:
    """Take long enough for something to happen meanwhile."""
    time.sleep(0.1)
    return quick(spec)


def raising(spec: TrialSpec) -> TrialResult:
    if spec.seed == BROKEN_SEED:
        raise ZeroDivisionError("the seed is broken")
    return quick(spec)


def unusable(spec: TrialSpec) -> TrialResult:
    """Find, as the kernel does, that the machine runs no trial."""
    if spec.seed == BROKEN_SEED:
        raise UnusableEnvironmentError("the machine has no compiler: install one")
    return quick(spec)


def exiting(spec: TrialSpec) -> TrialResult:
    """Leave, as a script does that is run as a part of something else."""
    if spec.seed == BROKEN_SEED:
        raise SystemExit(3)
    return quick(spec)


def deadly(spec: TrialSpec) -> TrialResult:
    """End the worker, as the kernel does when memory runs out."""
    if spec.seed == BROKEN_SEED:
        os.kill(os.getpid(), signal.SIGKILL)
    return quick(spec)


def malformed(spec: TrialSpec) -> TrialResult:
    """Return one step too few."""
    result = quick(spec)
    if spec.seed != BROKEN_SEED:
        return result
    return TrialResult(**{**vars(result), "loss": result.loss[:-1]})


def diverging(spec: TrialSpec) -> TrialResult:
    return diverged(spec, at=3) if spec.seed == BROKEN_SEED else quick(spec)


def diverged(spec: TrialSpec, at: int) -> TrialResult:
    """Return the same numbers up to a step, and none after it."""
    result = quick(spec)
    arrays = {
        name: np.where(np.arange(len(value)) < at, value, np.nan)
        for name, value in vars(result).items()
        if name in ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us")
    }
    return TrialResult(**{**vars(result), **arrays, "diverged_at": at})


def trial_of(policy: str, seed: int, **env: object) -> TrialSpec:
    """Return a short trial of a policy."""
    content = specification(seed, **env).to_mapping()
    return TrialSpec.from_mapping({**content, "policy": {"name": policy}})


def grid_of(policies: Sequence[str], seeds: int, **env: object) -> Grid:
    """Return a grid of short trials, seed by seed."""
    trials = [trial_of(policy, seed, **env) for seed in range(seeds) for policy in policies]
    return Grid(trials, n_jobs=len(trials), left_out={})
