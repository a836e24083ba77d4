"""Properties of a system: linear dynamics about its equilibrium, effect of inputs, sizes of states.

Sizes make the numbers of a plant independent of the units that it declares. A state has the
half-width of the box, and an angle 1 rad. The size of another one is what its known rate makes of
the others within ``STEPS_ACROSS`` steps, or what makes that much of another one.

A learned state is divided by what it changes by in a second when it crosses its size in
``STEPS_ACROSS`` steps: then that acceleration is 1, and accelerations of plants are of the order
of the outputs of a network. If a unit is another one by some factor its sizes are so, and where
that is a power of two they are so bit for bit. Other factors are rounded, by some 1e-16, which
learners that solve for all parameters at once amplify a million million times: so scaled numbers
are rounded to 36 bits, after which most of them are the same ones in all units. Angles have one
unit and are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dopt.systems.base import Array, System
from dopt.types import Scalar

STEP = 1e-30
"""Imaginary step: the derivative is exact to rounding, nothing is subtracted."""

EQUAL = 1e-9
"""Decay rates that differ by less than this share of the largest eigenvalue are equal."""


@dataclass(frozen=True)
class Eigenmode:
    """An oscillation about the stable equilibrium.

    Attributes
    ----------
    frequency : float
        Damped angular frequency [rad/s], the imaginary part of the eigenvalue.
    decay : float
        Decay rate [1/s], minus its real part.
    direction : (m,)
        Unit input that drives the mode most.
    """

    frequency: float
    decay: float
    direction: Array


def jacobians(system: System, state: npt.ArrayLike, inputs: npt.ArrayLike) -> tuple[Array, Array]:
    """Return A = ∂f/∂x, (d, d), and B = ∂f/∂u, (d, m), by complex steps.

    Reference: W. Squire and G. Trapp, "Using complex variables to estimate derivatives of real
    functions", SIAM Review 40 (1998).
    """
    x = np.asarray(state, dtype=complex)
    u = np.asarray(inputs, dtype=complex)
    by_state = [system.derivative(x + step, u).imag / STEP for step in 1j * STEP * np.eye(len(x))]
    by_input = [system.derivative(x, u + step).imag / STEP for step in 1j * STEP * np.eye(len(u))]
    return np.stack(by_state, axis=1), np.stack(by_input, axis=1)


def eigenmode(system: System) -> Eigenmode | None:
    """Return the least damped oscillation about the stable equilibrium, None when none exists.

    Of modes that are equally damped, the slowest: rounding must not choose. Hardware around the
    system has no part in it.
    """
    system = system.wrapped or system
    if system.equilibrium is None:
        return None
    A, B = jacobians(system, system.equilibrium, np.zeros(system.n_inputs))
    values, vectors = np.linalg.eig(A)
    oscillating = np.flatnonzero(values.imag > 1e-9)
    if not len(oscillating):
        return None
    growth = values[oscillating].real
    least_damped = oscillating[growth >= growth.max() - EQUAL * np.abs(values).max()]
    least = least_damped[np.argmin(values[least_damped].imag)]
    drive = np.linalg.inv(vectors)[least] @ B
    _, axes = np.linalg.eigh(np.real(np.outer(drive, drive.conj())))
    direction = axes[:, -1] * np.sign(axes[np.argmax(np.abs(axes[:, -1])), -1])
    return Eigenmode(float(values[least].imag), float(-values[least].real), direction)


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
        values = system.known_flow(states.T, inputs.T).T
    return np.where(np.isfinite(values), values, 0.0)


STEPS_ACROSS = 250
"""Steps in which a learned acceleration of 1 leads from the middle of the box to its side."""

UNKNOWN_STEP = 2.0**-20
"""Change of a state of unknown size by which others are seen to depend on it."""

SPLIT = 2.0**17 + 1.0
"""Factor whose product with a number leaves its first 36 bits of 53, rounded.

Reference: T. Dekker, "A floating-point technique for extending the available precision" (1971).
"""

_SIZES_SEED = 20_261_128


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
    for j, step in enumerate(np.diag(np.where(np.isnan(sizes), UNKNOWN_STEP, 0.0))):
        change = np.abs(_flow(system, sizes, step) - _flow(system, sizes, -step)).max(axis=1)
        known = (change > 0.0) & ~np.isnan(sizes)
        if known.any():
            found[j] = np.min(sizes[known] / (seconds * change[known])) * (2.0 * UNKNOWN_STEP)
    return found


def _flow(system: System, sizes: Array, step: Array) -> Array:
    """Return the known part, (d, TRIED), in a box of the sizes, with a step added; 0 at a pole."""
    rng = np.random.default_rng(_SIZES_SEED)
    states = np.nan_to_num(sizes)[:, None] * rng.uniform(-1.0, 1.0, (len(sizes), TRIED))
    inputs = rng.standard_normal((system.n_inputs, TRIED))
    inputs *= system.gamma / np.linalg.norm(inputs, axis=0)
    return _known(system, states + step[:, None], inputs)
