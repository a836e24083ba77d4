"""The unbalanced disk of ``studies/real``, as its fit describes it, as a system to explore."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from dopt.fields import parameter
from dopt.systems import Feature, System
from dopt.systems.elementary import sin, tanh

DELAY = 0.025212
"""Delay of the fit [s]."""

UNIT = 10.0
"""Unit of the rate [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class Disk(System):
    """Motor with an eccentric mass: θ̈ = g u - d θ̇ - m sin(θ + φ) - c tanh(2 θ̇) + b.

    State: angle θ from below [rad], rate ω = θ̇ [10 rad/s]. Input: voltage u [V], whose effect is
    known. Learned: dω/dt, which is of the size that networks learn in this unit.

    Notes
    -----
    Reasons for the default values:

    - constants: ``dopt.fit`` to the 30,000 samples of ``disk_train``, without a network.
    - gamma, box: range of the recorded run.
    - dt: a fifth of the recorded 25 ms, of which the Euler map would gain energy; the horizon of
      2.5 s is as many samples as in the paper's trials.
    """

    name: ClassVar[str] = "disk"
    compiled: ClassVar[bool] = True
    physical: ClassVar[tuple[str, ...]] = (
        *("gain", "damping", "gravity", "offset", "coulomb", "bias"),
    )
    state_labels: ClassVar[tuple[str, ...]] = ("θ [rad]", "ω [10 rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [V]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1,)
    features: ClassVar[tuple[Feature, ...]] = (
        Feature("cos", 0),
        Feature("sin", 0),
        Feature("identity", 1),
    )
    angle_indices: ClassVar[tuple[int, ...]] = (0,)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1)

    gain: float = parameter(28.718, "rad/s²/V", "positive")
    damping: float = parameter(1.0512, "1/s", "nonnegative")
    gravity: float = parameter(136.46, "1/s²", "nonnegative")
    offset: float = parameter(-0.04938, "rad")
    coulomb: float = parameter(6.8517, "1/s²", "nonnegative")
    bias: float = parameter(-1.9023, "1/s²")
    gamma: float = parameter(3.0, "V", "positive")
    dt: float = parameter(0.005, "s", "positive")
    horizon: int = parameter(500, "steps", "positive")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((math.pi, 2.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((32, 32), bound="positive")

    @staticmethod
    def known(state: Any, inputs: Any, parameters: Any) -> tuple[Any, ...]:
        return UNIT * state[1], parameters[0] * inputs[0] / UNIT

    @staticmethod
    def accelerations(state: Any, parameters: Any) -> tuple[Any, ...]:
        _, damping, gravity, offset, coulomb, bias = parameters
        rate = UNIT * state[1]
        slowed = damping * rate + coulomb * tanh(2.0 * rate)
        return ((bias - gravity * sin(state[0] + offset) - slowed) / UNIT,)
