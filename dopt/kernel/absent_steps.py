"""Steps of a trial without limits, whose states are all known, or that the interpreter takes."""

from __future__ import annotations

from dopt.kernel.compiler import compiled
from dopt.kernel.structs import Trial
from dopt.types import Vector


@compiled
def plan(trial: Trial, t: int, u: Vector) -> None:
    """Leave u_t as a plan in numpy has chosen it."""


@compiled
def learn(trial: Trial, t: int, target: Vector) -> None:
    """Leave the parameters as an update in numpy has returned them."""


@compiled
def limit_input(trial: Trial, t: int, u: Vector) -> None:
    """Leave u_t as the policy chose it."""


@compiled
def note_error(trial: Trial, t: int, target: Vector) -> None:
    """Remember nothing of the model's errors."""


@compiled
def estimate_state(trial: Trial, t: int, dt: float) -> None:
    """Leave x_{t+1} as it is known."""
