"""Bodies have the right shape: rigid links, and the lengths and positions of the equations."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.geometry import Body, body
from dopt.systems import SYSTEMS, Arm, Cartpole, MassSpring, Pendulum, Quadrotor, System


def states(system: System, n: int = 50) -> np.ndarray:
    return np.random.default_rng(0).normal(scale=2.0, size=(n, system.n_states))


def body_of(system: System, at: np.ndarray) -> Body:
    found = body(system, at)
    assert found is not None
    return found


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_shipped_system_has_a_rigid_body(name: str) -> None:
    system = SYSTEMS[name]()
    for line in body_of(system, states(system)).lines:
        lengths = np.linalg.norm(np.diff(line, axis=1), axis=-1)
        np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], lengths.shape))


def test_a_pendulum_hangs_at_rest_and_swings_to_the_right() -> None:
    tips = body_of(Pendulum(length=2.0), np.array([[0.0, 0.0], [np.pi / 2, 0.0]])).masses[:, 0]
    np.testing.assert_allclose(tips, [[0, -2], [2, 0]], atol=1e-12)


def test_the_height_of_a_mass_is_its_potential_energy() -> None:
    """The weight times the height is the energy whose slope the equations feel."""
    system, eps = Pendulum(friction=0.0), 1e-6
    angles = np.linspace(-3, 3, 20)
    up, down = (
        body_of(system, np.stack([angles + sign * eps, 0 * angles], axis=1)).masses[:, 0, 1]
        for sign in (1, -1)
    )
    slope = system.mass * system.gravity * (up - down) / (2 * eps) / 2  # the rod's middle
    inertia = system.mass * system.length**2 / 3
    accelerations = system.learned(np.stack([angles, 0 * angles], axis=1))[:, 0]
    np.testing.assert_allclose(-slope / inertia, accelerations, rtol=1e-6)


def test_a_pole_stands_upright_at_zero_and_leans_to_the_right() -> None:
    at = np.array([[1.0, 0, 0, 0], [1.0, 0, np.pi / 2, 0]])
    np.testing.assert_allclose(body_of(Cartpole(), at).masses[:, 0], [[1, 1], [2, 0]], atol=1e-12)


def test_an_arm_has_absolute_angles() -> None:
    hand = body_of(Arm(), np.array([[np.pi / 2, 0, 0.0, 0]])).masses[0, 1]
    np.testing.assert_allclose(hand, [1, -1], atol=1e-12)


def test_a_quadrotor_tilts_its_right_side_up() -> None:
    (bar,) = body_of(Quadrotor(), np.array([[3.0, 0, 4.0, 0, 0.1, 0]])).lines
    assert bar[0, 1, 1] > 4.0 > bar[0, 0, 1]
    np.testing.assert_allclose(bar[0].mean(axis=0), [3, 4])


def test_masses_between_springs_move_along_a_level_line() -> None:
    found = body_of(MassSpring(), np.array([[0.0, 1.0, 0.0, 2.0], [0.5, 0.0, -0.5, 0.0]])).masses
    np.testing.assert_allclose(found, [[[-1, 0], [1, 0]], [[-0.5, 0], [0.5, 0]]])
