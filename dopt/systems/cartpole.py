"""Cartpole with linear friction: a point mass on a massless rod, hinged to a cart."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from dopt.fields import parameter
from dopt.systems.base import Feature, System, identity, turn
from dopt.systems.elementary import cos, sin
from dopt.types import Scalar


def _free_accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
    """Return the accelerations without input, for numbers, arrays and tensors."""
    cart_mass, pole_mass, length, gravity, alpha, beta = parameters
    _, speed, angle, rate = state
    sine, cosine = sin(angle), cos(angle)
    hinge = alpha * rate / length
    force = pole_mass * sine * (length * rate**2 - gravity * cosine) + hinge * cosine - beta * speed
    cart = force / (cart_mass + pole_mass - pole_mass * cosine**2)
    pole = (gravity * sine - cart * cosine - hinge / pole_mass) / length
    return cart, pole


@dataclass(frozen=True, kw_only=True)
class Cartpole(System):
    """Cart on a track with a point mass on a rod, pushed by a force on the cart.

    State: cart position y [m], ẏ [m/s], angle φ from upright [rad], φ̇ [rad/s]. Input: force u [N].

    With M = m_c + m_p:
    M ÿ + m_p l (φ̈ cos φ - φ̇² sin φ) = u - β ẏ,
    m_p l² φ̈ + m_p l ÿ cos φ - m_p g l sin φ = -α φ̇.
    Learned: ÿ and φ̈ at u = 0. Known: the input column.

    Parameters
    ----------
    cart_mass, pole_mass : float
        Masses m_c and m_p [kg].
    length : float
        Length l of the rod [m].
    gravity : float
        Gravitational acceleration g [m/s²].
    pivot_friction : float
        Viscous friction coefficient α of the hinge [N m s].
    cart_friction : float
        Viscous friction coefficient β of the track [N s/m].
    """

    name: ClassVar[str] = "cartpole"
    physical: ClassVar[tuple[str, ...]] = (
        "cart_mass",
        "pole_mass",
        "length",
        "gravity",
        "pivot_friction",
        "cart_friction",
    )
    linear_parameters: ClassVar[tuple[str, ...]] = ("gravity", "pivot_friction", "cart_friction")
    state_labels: ClassVar[tuple[str, ...]] = ("y [m]", "ẏ [m/s]", "φ [rad]", "φ̇ [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [N]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1, 3)
    features: ClassVar[tuple[Feature, ...]] = (*identity(1), *turn(2), *identity(3))
    angle_indices: ClassVar[tuple[int, ...]] = (2,)
    phase_plane: ClassVar[tuple[int, int]] = (2, 3)
    grid_indices: ClassVar[tuple[int, ...]] = (1, 2, 3)
    equilibrium: ClassVar[tuple[float, ...] | None] = (0.0, 0.0, math.pi, 0.0)

    cart_mass: float = parameter(1.0, "kg", "positive")
    pole_mass: float = parameter(0.1, "kg", "positive")
    length: float = parameter(1.0, "m", "positive")
    gravity: float = parameter(10.0, "m/s²", "nonnegative")
    pivot_friction: float = parameter(0.02, "N m s", "nonnegative")
    cart_friction: float = parameter(0.5, "N s/m", "nonnegative")
    gamma: float = parameter(7.0, "N", "positive")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0, math.pi, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((4.0, math.pi, 6.4), bound="positive")
    grid_points: tuple[int, ...] = parameter((8, 16, 8), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        cart_mass, pole_mass, length, _, _, _ = parameters
        cosine = cos(state[2])
        push = inputs[0] / (cart_mass + pole_mass - pole_mass * cosine**2)
        return state[1], push, state[3], -push * cosine / length

    accelerations = staticmethod(_free_accelerations)


@dataclass(frozen=True, kw_only=True)
class CartpoleUnknownGain(Cartpole):
    """The cartpole, pushed by a motor of which nobody knows what force it gives.

    The force on the cart is k u. Both accelerations with all effects of u are learned. With k = 1
    it moves as the cartpole does.

    Parameters
    ----------
    gain : float
        k, force by input.

    Notes
    -----
    It takes ``model=affine`` or ``model=black_box``.
    """

    name: ClassVar[str] = "cartpole_unknown_gain"
    reads_inputs: ClassVar[bool] = True
    physical: ClassVar[tuple[str, ...]] = (*Cartpole.physical, "gain")
    linear_parameters: ClassVar[tuple[str, ...]] = (*Cartpole.linear_parameters, "gain")

    gain: float = parameter(1.0, bound="nonnegative")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:  # noqa: ARG004
        return state[1], 0.0 * state[1], state[3], 0.0 * state[3]

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        place, speed, angle, rate, u = state
        cart_mass, pole_mass, length, gravity, alpha, beta, gain = parameters
        cart, pole = _free_accelerations(
            (place, speed, angle, rate), (cart_mass, pole_mass, length, gravity, alpha, beta)
        )
        cosine = cos(angle)
        push = gain * u / (cart_mass + pole_mass - pole_mass * cosine**2)
        return cart + push, pole - push * cosine / length
