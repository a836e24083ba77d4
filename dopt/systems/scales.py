"""Sizes of the states of a plant, in which its numbers do not depend on the units it declares.

A state has the half-width of the box, and an angle 1 rad. The size of another one is what its known
rate makes of the others within ``STEPS_ACROSS`` steps, or what makes that much of another one.

A learned state is divided by what it changes by in a second when it crosses its size in
``STEPS_ACROSS`` steps: then that acceleration is 1, and accelerations of plants are of the order
of the outputs of a network. If a unit is another one by some factor its sizes are so, and where
that is a power of two they are so bit for bit. Other factors are rounded, by some 1e-16, which
learners that solve for all parameters at once amplify a million million times: so scaled numbers
are rounded to 36 bits, after which most of them are the same ones in all units. Angles have one
unit and are not.
"""

from __future__ import annotations

import numpy as np

from dopt.systems.base import Array, System
from dopt.types import Scalar

STEPS_ACROSS = 250
"""Steps in which a learned acceleration of 1 leads from the middle of the box to its side."""

TRIED = 64
"""States of the box and inputs at which the known rates are taken."""

STEP = 2.0**-20
"""Change of a state of unknown size by which others are seen to depend on it."""

SPLIT = 2.0**17 + 1.0
"""Factor whose product with a number leaves its first 36 bits of 53, rounded.

Reference: T. Dekker, "A floating-point technique for extending the available precision" (1971).
"""

_SEED = 20_261_128


def rounded(values: Scalar, split: Scalar = SPLIT) -> Scalar:
    """Return numbers rounded to 36 bits, or as they are where ``split`` is 0."""
    product = split * values
    return product - (product - values)


def scales(system: System, sizes: Array) -> tuple[float, ...]:
    """Return what each state of a plant is divided by, given its size, (d,); 1 for an angle."""
    found = sizes.copy()
    found[list(system.learned_rows)] /= STEPS_ACROSS * system.dt
    found[list(system.angle_indices)] = 1.0
    return tuple(found.tolist())


def sizes(system: System) -> Array:
    """Return the size of each state, (d,); 1 for one of which nothing is declared."""
    known = np.full(system.n_states, np.nan)
    known[list(system.grid_indices)] = system.grid_half_widths
    seconds = STEPS_ACROSS * system.dt
    for find in (_by_rates, _by_effects) * system.n_states:
        found = find(system, known, seconds)
        known = np.where(np.isnan(known) & (found > 0.0), found, known)
    return np.where(np.isnan(known), 1.0, known)


def _by_rates(system: System, sizes: Array, seconds: float) -> Array:
    """Return how far the known rates lead in some time, (d,), in a box of the sizes found."""
    largest: Array = np.abs(_flow(system, sizes, np.zeros(len(sizes)))).max(axis=1)
    return seconds * largest


def _by_effects(system: System, sizes: Array, seconds: float) -> Array:
    """Return what makes other states change by their sizes in some time, (d,); 0 for nothing."""
    found = np.zeros(len(sizes))
    for j, step in enumerate(np.diag(np.where(np.isnan(sizes), STEP, 0.0))):
        change = np.abs(_flow(system, sizes, step) - _flow(system, sizes, -step)).max(axis=1)
        known = (change > 0.0) & ~np.isnan(sizes)
        if known.any():
            found[j] = np.min(sizes[known] / (seconds * change[known])) * (2.0 * STEP)
    return found


def _flow(system: System, sizes: Array, step: Array) -> Array:
    """Return the known part, (d, TRIED), in a box of the sizes, with a step added; 0 at a pole."""
    rng = np.random.default_rng(_SEED)
    states = np.nan_to_num(sizes)[:, None] * rng.uniform(-1.0, 1.0, (len(sizes), TRIED))
    inputs = rng.standard_normal((system.n_inputs, TRIED))
    inputs *= system.gamma / np.linalg.norm(inputs, axis=0)
    with np.errstate(all="ignore"):
        flow = system.known(tuple(states + step[:, None]), tuple(inputs), system.parameters)
        values = np.stack(np.broadcast_arrays(*flow, states[0])[:-1])
    return np.where(np.isfinite(values), values, 0.0)
