"""Numbers that an agent is shown of a state."""

from __future__ import annotations

import numpy as np

from dopt.systems.base import System
from dopt.types import Array

LIMIT = 10.0
"""Largest size of an observed number."""


class Observation:
    """Map of states to the numbers that an agent is shown, about 1 in size.

    An angle is its cosine and sine, any other component is divided by the half-width of the
    evaluation grid where it has one.
    """

    def __init__(self, system: System) -> None:
        widths = dict(zip(system.grid_indices, system.grid_half_widths, strict=True))
        self._angles = list(system.angle_indices)
        self._others = [i for i in range(system.n_states) if i not in self._angles]
        self._scales = np.array([widths.get(i, 1.0) for i in self._others])

    @property
    def size(self) -> int:
        """Number of observed numbers."""
        return len(self._others) + 2 * len(self._angles)

    def __call__(self, states: Array) -> Array:
        """Return what is observed of states, (..., d), as (..., size)."""
        angles, others = states[..., self._angles], states[..., self._others] / self._scales
        parts = [np.cos(angles), np.sin(angles), np.clip(others, -LIMIT, LIMIT)]
        return np.concatenate(parts, axis=-1)
