"""Inputs that were drawn before the trial, in compiled code."""

from __future__ import annotations

from dopt.kernel.compiler import compiled
from dopt.kernel.structs import Trial
from dopt.types import Vector


@compiled
def plan(trial: Trial, t: int, u: Vector) -> None:
    """Write the input u_t, (m,), as it was drawn."""
    for j in range(u.shape[0]):
        u[j] = trial.randomness.inputs[t, j]
