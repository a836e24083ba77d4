"""Inputs that stand for the actions of an agent."""

from __future__ import annotations

import numpy as np

from dopt.control.planner import within_ball
from dopt.policies.base import on_sphere
from dopt.types import Array


def input_of(actions: Array, gamma: float, energy: str) -> Array:
    """Return inputs, (..., m), of norm γ or at most γ, for actions, (..., m), within ±1.

    With the full energy the direction of the action counts alone; that of no action is the first.
    """
    if energy == "below":
        return within_ball(gamma * actions, gamma)
    first = np.eye(actions.shape[-1])[0]
    still = np.all(actions == 0.0, axis=-1, keepdims=True)
    return on_sphere(np.where(still, first, actions), gamma)
