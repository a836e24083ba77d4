"""Damped point mass in the plane, pushed by a star that moves on a circle."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.declare.validated_fields import parameter
from dopt.systems.base import Array, System
from dopt.systems.features import Feature
from dopt.types import Scalar


@dataclass(frozen=True, kw_only=True)
class MovingStar(System):
    """Point mass without inertia in a central force field whose centre circles about the origin.

    State: position x, y [m]. Inputs: force uₓ, u_y [N].

    α q̇ = F(q - c(t)) + u, with F(s) = A s / (√(|s|² + ε²) (1 + |s|²/ρ²)), a force away from the
    star that is largest about ε and falls to half of A at ρ, and c(t) = R (cos ωt, sin ωt).
    Learned: F/α. Known: u/α. The model is not told the time: centre and radius are what it is to
    follow (``model=grey_box``).

    Source: the star of Section 6.2 of M. Blanke and M. Lelarge, "FLEX: an adaptive exploration
    algorithm for nonlinear systems" (2023). Their mass has an inertia, and the friction α = 100 for
    steps of 0.01: by the Euler map its velocity then is dt (F + u), without a memory, and a step
    moves it by dt²(F + u). That is the map of this system with dt/α = 1e-4 s²/kg, one step later
    and with F where the mass was a step before.
    In their code a barrier of width 0.02 keeps the mass from the centre, where F has no direction;
    here ε makes F smooth there.

    Parameters
    ----------
    friction : float
        α [N s/m].
    strength : float
        A, largest force [N].
    radius : float
        ρ [m].
    core : float
        ε [m].
    orbit : float
        R [m].
    period : float
        2π/ω [s].
    """

    name: ClassVar[str] = "moving_star"
    physical: ClassVar[tuple[str, ...]] = (
        *("friction", "strength", "radius", "core", "center_x", "center_y"),
    )
    linear_parameters: ClassVar[tuple[str, ...]] = ("strength",)
    state_labels: ClassVar[tuple[str, ...]] = ("x [m]", "y [m]")
    input_labels: ClassVar[tuple[str, ...]] = ("uₓ [N]", "u_y [N]")
    learned_rows: ClassVar[tuple[int, ...]] = (0, 1)
    features: ClassVar[tuple[Feature, ...]] = (Feature("identity", 0), Feature("identity", 1))
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1)

    friction: float = parameter(1.0, "N s/m", "positive")
    strength: float = parameter(1.0, "N", "nonnegative")
    radius: float = parameter(0.5, "m", "positive")
    core: float = parameter(0.02, "m", "positive")
    orbit: float = parameter(0.9, "m", "nonnegative")
    period: float = parameter(0.1, "s", "positive")
    gamma: float = parameter(50.0, "N", "positive")
    dt: float = parameter(1e-4, "s", "positive")
    noise: float = parameter(1e-6, bound="nonnegative")
    horizon: int = parameter(1000, "steps", "positive")
    initial_state: tuple[float, ...] = parameter((0.8, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((1.0, 1.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((20, 20), bound="positive")

    @property
    def parameters(self) -> tuple[float, ...]:
        """Physical parameters in the order of ``physical``, with the centre at t = 0."""
        return self.friction, self.strength, self.radius, self.core, self.orbit, 0.0

    @functools.cached_property
    def history(self) -> Array:
        """Physical parameters of each step, (T, number of them)."""
        rows = np.tile(np.array(self.parameters), (self.horizon, 1))
        angle = 2.0 * math.pi / self.period * self.dt * np.arange(self.horizon)
        rows[:, self.physical.index("center_x")] = self.orbit * np.cos(angle)
        rows[:, self.physical.index("center_y")] = self.orbit * np.sin(angle)
        return rows

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:  # noqa: ARG004  # the input alone
        return inputs[0] / parameters[0], inputs[1] / parameters[0]

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        friction, strength, radius, core, center_x, center_y = parameters
        x, y = state[0] - center_x, state[1] - center_y
        square = x * x + y * y
        fall = (square + core * core) ** 0.5 * (1.0 + square / (radius * radius))
        factor = strength / (friction * fall)
        return factor * x, factor * y
