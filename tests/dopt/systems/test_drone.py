"""The drone: hovering, the norm of its quaternion, and its terminal speed."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.evaluation import simulate
from dopt.systems import Drone


def test_an_upright_drone_hovers_and_one_upside_down_falls() -> None:
    drone = Drone()
    assert drone.derivative(drone.initial_state, np.zeros(4)) == pytest.approx(0.0, abs=1e-14)
    over = np.zeros(13)
    over[7] = 1.0  # half a turn about the body's x axis
    fall = drone.derivative(over, np.zeros(4))
    assert fall[5] == pytest.approx(-2.0 * drone.gravity)
    assert np.delete(fall, 5) == pytest.approx(0.0, abs=1e-14)


def test_euler_steps_keep_the_norm_of_the_quaternion() -> None:
    drone = Drone()
    inputs = np.random.default_rng(0).normal(size=(50, 8, 4)).repeat(10, axis=0)
    inputs /= np.linalg.norm(inputs, axis=-1, keepdims=True)
    path = simulate(drone, drone.gamma * inputs)
    assert np.abs(path[..., 10:]).max() > 2.0, "it turns"
    assert np.linalg.norm(path[..., 6:10], axis=-1) == pytest.approx(1.0, abs=0.01)


def test_drag_balances_a_fall_at_the_terminal_speed() -> None:
    """ρ √(v² + v₀²) v = 2 m g for a drone that falls upside down."""
    drone = Drone()
    square = drone.slow_speed**2
    weight = 2.0 * drone.mass * drone.gravity / drone.drag
    speed = np.sqrt((np.sqrt(square**2 + 4.0 * weight**2) - square) / 2.0)
    state = np.zeros(13)
    state[5], state[7] = -speed, 1.0
    assert drone.derivative(state, np.zeros(4))[5] == pytest.approx(0.0, abs=1e-12)
