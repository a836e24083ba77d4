"""The car: straight on, round a bend, and at the limit of its grip."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dopt.evaluation import simulate
from dopt.systems import Car


def test_without_steering_it_drives_straight_on_to_its_terminal_speed() -> None:
    car = Car()
    path = simulate(car, np.tile([1.0, 0.0], (1500, 1, 1)))[-1, 0]
    assert path[3] == pytest.approx(math.sqrt(car.motor / car.drag), rel=1e-6)
    assert path[[1, 2, 4, 5, 6]] == pytest.approx(0.0, abs=1e-12)


def test_a_slow_car_with_grip_turns_about_the_point_where_its_axles_meet() -> None:
    """The yaw rate is that of wheels that do not slip: vₓ tan δ by the distance of the axles."""
    car = Car(front_grip=600.0, rear_grip=600.0, dt=1e-3)
    path = simulate(car, np.tile([0.05, 0.5], (6000, 1, 1)))[-1, 0]
    assert path[6] == pytest.approx(0.3, rel=1e-6)
    turning = path[3] * math.tan(0.3) / (car.front + car.rear)
    assert path[5] == pytest.approx(turning, rel=0.02)
    assert path[4] == pytest.approx(car.rear * path[5], rel=0.02)


def test_a_tyre_never_pulls_harder_than_its_grip() -> None:
    car = Car(drag=0.0)
    rng = np.random.default_rng(0)
    rows = car.learned(rng.normal(scale=20.0, size=(500, 7)))
    force = car.mass * np.linalg.norm(rows[:, :2], axis=1)
    assert force.max() <= car.front_grip + car.rear_grip
    assert force.max() > 0.9 * (car.front_grip + car.rear_grip)
