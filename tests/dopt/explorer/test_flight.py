"""Explorations of plants whose inputs come late, slowly or cut."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from dopt import Explorer, Plant, unknown
from dopt.errors import SpecificationError
from dopt.systems import Pendulum, Real
from tests.dopt.explorer.plants import MOTOR, Rig, motor_acceleration
from tests.waiting import PATIENCE_SECONDS

DT = MOTOR.dt


def declared(**more: Any) -> Plant:
    return dataclasses.replace(MOTOR, **more)


def behind(hardware: dict[str, float]) -> Rig:
    """Return the rig of which the plant declares the hardware."""
    return Rig(**(hardware | {"delay": hardware["delay"] / DT}))


def explored(plant: Plant, rig: Rig, steps: int = 250, **more: Any) -> Explorer:
    explorer = Explorer(plant, **{"steps": 300, "learner": "gauss_newton", **more})
    for _ in range(steps):
        explorer.tell(rig.step(explorer.ask(rig.x)))
    return explorer


def error(explorer: Explorer) -> float:
    states = np.random.default_rng(0).uniform([-math.pi, -10], [math.pi, 10], (200, 2))
    true = np.array([motor_acceleration(x) for x in states])
    return float(np.sqrt(np.mean((explorer.predict(states)[:, 0] - true) ** 2)))


@pytest.mark.parametrize(
    "rig", [{"delay": 1.7 * DT}, {"delay": 2 * DT, "lag": 0.03, "supply": 5.0}], ids=str
)
def test_what_is_declared_is_recovered_as_without_it(rig: dict[str, float]) -> None:
    explorer = explored(declared(**rig), known := behind(rig))
    np.testing.assert_allclose(explorer.inputs, known.acted, atol=1e-12)
    assert np.abs(explorer.inputs).max() <= rig.get("supply", 6.0) + 1e-12
    assert error(explorer) < 0.5
    assert error(explored(MOTOR, behind(rig))) > 5.0


def test_the_first_guess_of_an_unknown_delay_is_taken_also_by_a_policy_that_searches() -> None:
    given: dict[str, Any] = {"policy": "exact", "deadline": PATIENCE_SECONDS}
    with (
        explored(declared(delay=unknown(DT, spread=0.01)), Rig(1.0), 30, **given) as one,
        explored(declared(delay=DT), Rig(1.0), 30, policy="exact") as other,
    ):
        np.testing.assert_array_equal(one.parameters, other.parameters)
        assert (one.counts["missed"], one.counts["learned"]) == (0, 30)


@pytest.mark.parametrize("policy", ["d_optimal", "uniform"])
def test_the_plan_is_that_of_a_simulated_system_behind_the_same_delay(policy: str) -> None:
    """Both plan for the state that the model predicts two steps ahead.

    The box and gamma are such that the scaled numbers of the plant are its own.
    """
    widths = (math.pi, 5.0)
    pendulum = Pendulum(horizon=60, grid_points=(4, 4), grid_half_widths=widths, gamma=1.0)
    numbers: dict[str, Any] = {"dt": pendulum.dt, "gamma": pendulum.gamma, "box": {"rate": 5.0}}
    known = {"angle": "rate", "rate": "3 * voltage"}
    plant = declared(known=known, constants={}, delay=2 * pendulum.dt, **numbers)
    real = Explorer(Real(pendulum, delay=2), policy=policy)
    own = Explorer(plant, steps=60, policy=policy)
    x = np.zeros(4)
    for _ in range(50):
        u = real.ask(x)
        np.testing.assert_allclose(own.ask(x[:2]), u)
        rate = pendulum.derivative(x[:2], x[3:4])
        x = np.array([*(x[:2] + pendulum.dt * rate), u[0], x[2]])
        real.tell(x)
        own.tell(x[:2])
    np.testing.assert_allclose(own.errors, real.errors, rtol=1e-6)


def test_in_a_gap_the_last_input_is_held() -> None:
    explorer = Explorer(declared(delay=2 * DT), policy="random", steps=20)
    explorer.ask([0.0, 0.0], time=0.0)
    for k in range(1, 5):
        assert explorer.tell([0.01 * k, 0.1], applied=[k], time=k * DT)
        explorer.ask([0.01 * k, 0.1], time=k * DT)
    np.testing.assert_allclose(explorer.inputs[:, 0], [0.0, 0.0, 1.0, 2.0])
    answer = explorer.ask([0.04, 0.1])[0]
    assert not explorer.tell([0.06, 0.1], time=5 * DT + 0.015)  # a gap of 1.75 dt
    assert explorer.tell([0.07, 0.1], applied=[9.0], time=6 * DT + 0.015)
    assert explorer.inputs[-1, 0] == pytest.approx(answer)  # held for two steps
    explorer.reset()
    explorer.ask([0.0, 0.0], time=0.0)
    assert explorer.tell([0.0, 0.1], applied=[1.0], time=DT)
    assert explorer.inputs[-1, 0] == 0.0


def test_a_free_run_is_told_what_acted() -> None:
    rig = Rig(2.0, 0.03)
    explorer = explored(declared(delay=2 * DT, lag=0.03), rig)
    rng, x, sent = np.random.default_rng(5), [rig.x], []
    held = [np.zeros(1)] * 30 + [rng.uniform(-6, 6, 1) for _ in range(20) for _ in range(10)]
    for u in held:
        sent.append(u)
        x.append(rig.step(u))
    late = explorer.free_run_error(np.array(x)[29:], np.array(sent)[29:], 10)
    without = explored(MOTOR, Rig()).free_run_error(np.array(x)[29:], np.array(sent)[29:], 10)
    assert late < 0.2 * without


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("delay", -0.1, "'delay' of a plant is -0.1"),
        ("delay", 1e6 * DT, "at most 100 times dt is expected"),
        ("lag", math.inf, "'lag' of a plant is inf"),
        ("supply", 0.0, "'supply' of a plant is 0.0"),
    ],
)
def test_impossible_numbers_are_refused(name: str, value: float, said: str) -> None:
    with pytest.raises(SpecificationError, match=said):
        declared(**{name: value})


def test_the_torch_path_plans_for_the_same_states() -> None:
    plant = declared(delay=1.5 * DT, lag=0.02)
    kernel = explored(plant, Rig(1.5, 0.02), 15, learner="adam_window")
    torch = explored(plant, Rig(1.5, 0.02), 15, learner="adam_window", path="reference")
    np.testing.assert_allclose(torch.inputs, kernel.inputs, atol=1e-9)
    np.testing.assert_allclose(torch.states, kernel.states, rtol=1e-6)


def test_a_measured_angle_alone_is_enough_behind_a_delay() -> None:
    def run(plant: Plant) -> float:
        policy = {"name": "d_optimal", "regularization": 3.0}
        explorer, rig = Explorer(plant, policy=policy, learner="joint_ekf", steps=300), Rig(2.0)
        rng, y = np.random.default_rng(2), rig.x[:1]
        for _ in range(300):
            y = rig.step(explorer.ask(y))[:1] + 0.002 * rng.standard_normal(1)
            explorer.tell(y)
        return error(explorer)

    measured = {"angle": 0.002}
    assert run(declared(measured=measured, delay=2 * DT)) < 0.5 * run(declared(measured=measured))
