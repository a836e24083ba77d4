"""Effect of the inputs on the known part of a system, tried at random."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.systems.base import System
from dopt.types import Array

TRIED = 64
"""States and inputs that are tried."""

ROUNDING = 1e-9
"""Largest departure from an affine effect, relative to the largest numbers."""

_SEED = 20_240_601


class InputEffect(NamedTuple):
    """Whether known(x, u) is affine in u, and the numbers of the inputs without any effect."""

    is_affine: bool
    without: list[int]


def input_effect(system: System) -> InputEffect:
    """Compare the known part at states of the box and inputs of norm γ, of either sign.

    Numbers that are not finite, as at a pole, do not count. What the equation raises is raised.
    """
    rng = np.random.default_rng(_SEED)
    widths = np.ones(system.n_states)
    widths[list(system.grid_indices)] = system.grid_half_widths
    states = widths[:, None] * rng.uniform(-1, 1, (system.n_states, TRIED))
    first, second = rng.standard_normal((2, system.n_inputs, TRIED))
    first, second = (system.gamma * u / np.linalg.norm(u, axis=0) for u in (first, second))
    free, one, other, both, back = (
        _known(system, states, u) for u in (0 * first, first, second, first + second, -first)
    )
    largest = np.abs(np.stack([free, one, other, back])).max()
    apart = [one + other - both - free, one + back - 2 * free]
    without = []
    for j in range(system.n_inputs):
        alone = np.zeros_like(first)
        alone[j] = system.gamma
        if not np.any(_known(system, states, alone) != free):
            without.append(j)
    return InputEffect(bool(np.abs(apart).max() <= ROUNDING * largest), without)


def _known(system: System, states: Array, inputs: Array) -> Array:
    """Return the known part, (d, N), at states (d, N) and inputs (m, N)."""
    with np.errstate(all="ignore"):
        flow = system.known(tuple(states), tuple(inputs), system.parameters)
        values = np.stack(np.broadcast_arrays(*flow, states[0])[:-1])
    return np.where(np.isfinite(values), values, 0.0)
