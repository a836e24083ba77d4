"""Properties of a system: linear dynamics about its equilibrium, and the effect of its inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dopt.systems.base import System

Array = npt.NDArray[np.float64]

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


def euler_spectral_radius(system: System) -> float:
    """Return the spectral radius of x -> x + dt f(x, 0) at the stable equilibrium."""
    state = system.equilibrium or system.initial_state
    A, _ = jacobians(system, state, np.zeros(system.n_inputs))
    return float(np.max(np.abs(1 + system.dt * np.linalg.eigvals(A))))


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
