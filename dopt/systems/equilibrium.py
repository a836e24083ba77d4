"""Linear dynamics about the stable equilibrium: Jacobians, eigenmode, the Euler map's stability."""

from __future__ import annotations

from dataclasses import dataclass

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

    Of modes that are equally damped, the slowest: rounding must not choose.
    """
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
