"""Steps of a trial that has no limits, or whose states are all known."""

from __future__ import annotations

from dopt.kernel.compiler import compiled
from dopt.kernel.structs import Trial
from dopt.types import Vector


@compiled
def limit_input(trial: Trial, t: int, u: Vector) -> None:
    """Leave u_t as the policy chose it."""


@compiled
def note_error(trial: Trial, t: int, target: Vector) -> None:
    """Remember nothing of the model's errors."""


@compiled
def estimate_state(trial: Trial, t: int, dt: float) -> None:
    """Leave x_{t+1} as it is known."""
