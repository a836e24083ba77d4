"""Links that hang from a pivot in a vertical plane: the paper's arm, and a chain with n links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from dopt.fields import parameter
from dopt.systems.base import Feature, Repeated, System, identity, turn
from dopt.systems.elementary import cos, sin
from dopt.types import Scalar


def _solved(
    state: Scalar, parameters: Scalar, right_1: Scalar, right_2: Scalar
) -> tuple[Scalar, Scalar]:
    """Return H(φ)⁻¹ (right_1, right_2) with the mass matrix H of the arm."""
    mass_1, mass_2, length_1, length_2, _, _ = parameters
    diagonal_1 = (mass_1 + mass_2) * length_1**2
    diagonal_2 = mass_2 * length_2**2
    coupling = mass_2 * length_1 * length_2 * cos(state[0] - state[2])
    determinant = diagonal_1 * diagonal_2 - coupling**2
    first = (diagonal_2 * right_1 - coupling * right_2) / determinant
    second = (diagonal_1 * right_2 - coupling * right_1) / determinant
    return first, second


@dataclass(frozen=True, kw_only=True)
class Arm(System):
    """Double pendulum with viscous friction, driven by generalised torques on both links.

    State: φ₁, φ̇₁, φ₂, φ̇₂, absolute angles from hanging [rad] and rates [rad/s]. Inputs: u₁, u₂
    [N m], conjugate to the absolute angles.

    H φ̈ + c + g = u - α φ̇ with H = [[(m₁+m₂) l₁², m₂ l₁ l₂ cos δ], [·, m₂ l₂²]],
    c = m₂ l₁ l₂ sin δ (φ̇₂², -φ̇₁²), g = ((m₁+m₂) g l₁ sin φ₁, m₂ g l₂ sin φ₂), δ = φ₁ - φ₂.
    Learned: φ̈₁ and φ̈₂ at u = 0. Known: H⁻¹ u.

    Parameters
    ----------
    mass_1, mass_2 : float
        Point masses m₁, m₂ [kg].
    length_1, length_2 : float
        Lengths l₁, l₂ of the links [m].
    gravity : float
        Gravitational acceleration g [m/s²].
    friction : float
        Viscous friction coefficient α of both angles [N m s].
    """

    name: ClassVar[str] = "arm"
    physical: ClassVar[tuple[str, ...]] = (
        "mass_1",
        "mass_2",
        "length_1",
        "length_2",
        "gravity",
        "friction",
    )
    linear_parameters: ClassVar[tuple[str, ...]] = ("gravity", "friction")
    state_labels: ClassVar[tuple[str, ...]] = ("φ₁ [rad]", "φ̇₁ [rad/s]", "φ₂ [rad]", "φ̇₂ [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u₁ [N m]", "u₂ [N m]")
    learned_rows: ClassVar[tuple[int, ...]] = (1, 3)
    features: ClassVar[tuple[Feature, ...]] = (*turn(0), *identity(1), *turn(2), *identity(3))
    angle_indices: ClassVar[tuple[int, ...]] = (0, 2)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1, 2, 3)
    equilibrium: ClassVar[tuple[float, ...] | None] = (0.0, 0.0, 0.0, 0.0)

    mass_1: float = parameter(1.0, "kg", "positive")
    mass_2: float = parameter(1.0, "kg", "positive")
    length_1: float = parameter(1.0, "m", "positive")
    length_2: float = parameter(1.0, "m", "positive")
    gravity: float = parameter(10.0, "m/s²", "nonnegative")
    friction: float = parameter(2.0, "N m s", "nonnegative")
    gamma: float = parameter(5.0, "N m", "positive")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0, 0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((0.65, 1.6, 1.0, 2.3), bound="positive")
    grid_points: tuple[int, ...] = parameter((6, 6, 6, 6), bound="positive")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        first, second = _solved(state, parameters, inputs[0], inputs[1])
        return state[1], first, state[3], second

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:
        mass_1, mass_2, length_1, length_2, gravity, friction = parameters
        angle_1, rate_1, angle_2, rate_2 = state
        twist = mass_2 * length_1 * length_2 * sin(angle_1 - angle_2)
        weight_1 = (mass_1 + mass_2) * gravity * length_1 * sin(angle_1)
        weight_2 = mass_2 * gravity * length_2 * sin(angle_2)
        torque_1 = -friction * rate_1 - twist * rate_2**2 - weight_1
        torque_2 = -friction * rate_2 + twist * rate_1**2 - weight_2
        return _solved(state, parameters, torque_1, torque_2)


def _solved_chain(state: Scalar, parameters: Scalar, right: list[Scalar]) -> list[Scalar]:
    """Return H(φ)⁻¹ right with the mass matrix H of the chain, by elimination.

    H is symmetric and positive definite: no pivots are sought, and its upper triangle is enough.
    """
    n, inertia = len(right), parameters[0] * parameters[1] ** 2
    upper = []
    solution = []
    for i in range(n):
        solution.append(right[i])
        for j in range(n):
            outer = max(i, j)
            upper.append(inertia * (n - outer) * cos(state[2 * i] - state[2 * j]))
    for j in range(n):
        for i in range(j + 1, n):
            ratio = upper[j * n + i] / upper[j * n + j]
            solution[i] = solution[i] - ratio * solution[j]
            for k in range(i, n):
                upper[i * n + k] = upper[i * n + k] - ratio * upper[j * n + k]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            solution[i] = solution[i] - upper[i * n + j] * solution[j]
        solution[i] = solution[i] / upper[i * n + i]
    return solution


@dataclass(frozen=True, kw_only=True)
class Chain(Repeated):
    """Chain of n massless links of length l with a mass m at the end of each, damped by its medium.

    State: φ₁, φ̇₁, …, φₙ, φ̇ₙ, absolute angles from hanging [rad] and rates [rad/s]. Inputs: the
    torques τ₁ … τₙ of the motors [N m]; the i-th turns link i against link i - 1.

    With nᵢⱼ = n + 1 - max(i, j), the number of masses that both links carry:
    Σⱼ nᵢⱼ m l² (cos(φᵢ - φⱼ) φ̈ⱼ + sin(φᵢ - φⱼ) φ̇ⱼ²) + nᵢᵢ m g l sin φᵢ
    = τᵢ - τᵢ₊₁ - b φ̇ᵢ with τₙ₊₁ = 0.
    Learned: all φ̈ᵢ at τ = 0. Known: H⁻¹ times the torques.

    The evaluation box has 2n axes, too many for a full grid: its points are a low-discrepancy set
    of ``grid_points`` states.

    Parameters
    ----------
    n_links : int
        Number n of links.
    mass, length : float
        Mass m [kg] and length l [m] of each link.
    gravity : float
        Gravitational acceleration g [m/s²].
    friction : float
        Viscous friction coefficient b of each link's rotation [N m s].
    initial_state, grid_half_widths : tuple of float
        Of all 2n components, or an angle and a rate, which then hold for every link.

    Notes
    -----
    Reasons for the default values:

    - n_links: 5: ten components of the state, five learned accelerations, five inputs.
    - gamma: 2 N m against a weight of up to 12 N m on the first joint: the chain swings, its
      free end can go over.
    - friction: 0.2 N m s on each link: all modes die out, and the Euler map with dt = 0.02 s
      has the spectral radius 0.995 at rest. One of at most 1 takes 0.0612 at least.
    - grid: about what the links stay within for 95 % of the time under strong inputs of this
      energy, the angles of the last two aside. Ten axes leave no room for a full grid: the
      points are a Sobol set, their number a power of two.
    - horizon: 10 s, about four periods of the slowest mode. The inputs of the oracle, all on
      the sphere and in step with the motion, drive the rates beyond what Euler steps of this
      length bear: its trials diverge, and are counted so.

    The pairs stand for every link; 2 n numbers in their place give each its own.
    """

    name: ClassVar[str] = "chain"
    physical: ClassVar[tuple[str, ...]] = ("mass", "length", "gravity", "friction")
    linear_parameters: ClassVar[tuple[str, ...]] = ("gravity", "friction")
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    low_discrepancy: ClassVar[bool] = True
    counted: ClassVar[str] = "n_links"
    most: ClassVar[int] = 100  # its mass matrix is solved without a thought for its structure
    repeated: ClassVar[dict[str, int]] = {"initial_state": 2, "grid_half_widths": 2}

    n_links: int = parameter(5, "links", "positive")
    mass: float = parameter(0.2, "kg", "positive")
    length: float = parameter(0.4, "m", "positive")
    gravity: float = parameter(10.0, "m/s²", "nonnegative")
    friction: float = parameter(0.2, "N m s", "nonnegative")
    gamma: float = parameter(2.0, "N m", "positive")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((1.0, 6.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((1024,), bound="positive")

    @staticmethod
    def shape(n: int) -> dict[str, tuple[object, ...]]:
        links, angles = range(1, n + 1), range(0, 2 * n, 2)
        return {
            "state_labels": tuple(x for i in links for x in (f"φ{i} [rad]", f"φ̇{i} [rad/s]")),
            "input_labels": tuple(f"τ{i} [N m]" for i in links),
            "learned_rows": tuple(range(1, 2 * n, 2)),
            "features": tuple(one for i in angles for one in (*turn(i), *identity(i + 1))),
            "angle_indices": tuple(angles),
            "grid_indices": tuple(range(2 * n)),
            "equilibrium": (0.0,) * (2 * n),
        }

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> Sequence[Scalar]:
        n = len(inputs)
        torques = [inputs[i] - inputs[i + 1] for i in range(n - 1)] + [inputs[n - 1]]
        accelerations = _solved_chain(state, parameters, torques)
        flow = []
        for i in range(n):
            flow.append(state[2 * i + 1])
            flow.append(accelerations[i])
        return flow

    @staticmethod
    def accelerations(state: Scalar, parameters: Scalar) -> Sequence[Scalar]:
        mass, length, gravity, friction = parameters
        n = len(state) // 2
        torques = []
        for i in range(n):
            angle, rate = state[2 * i], state[2 * i + 1]
            torque = -gravity * mass * length * (n - i) * sin(angle) - friction * rate
            for j in range(n):
                carried = mass * length**2 * (n - max(i, j))
                torque = torque - carried * sin(angle - state[2 * j]) * state[2 * j + 1] ** 2
            torques.append(torque)
        return _solved_chain(state, parameters, torques)
