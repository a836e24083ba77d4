"""Systems behind real hardware: an independent simulation, keys, and plans that are not blind."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest

from dopt.errors import IncompatibleError, SpecificationError
from dopt.evaluation import simulate
from dopt.kernel.from_spec import constants
from dopt.kernel.run import KernelTrial
from dopt.registry import section_of
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, Pendulum, Real, System, system_from_mapping
from dopt.systems.black_box import BlackBox, transitions
from dopt.types import Array
from tests.dopt.trials import trial

PAPER = ("pendulum", "cartpole", "arm", "quadrotor")
FINE = 200
"""Pieces into which the independent simulation cuts a step; delays are multiples of a piece."""


def simulated(system: System, asked: Array, **hardware: float) -> Array:
    """Return the states, (T + 1, d), under inputs in continuous time, with the Euler map."""
    delay, lag = hardware.get("delay", 0.0), hardware.get("lag", 0.0)
    coulomb, supply = hardware.get("coulomb", 0.0), hardware.get("supply", math.inf)
    sent = np.concatenate([np.zeros((1, system.n_inputs)), np.clip(asked, -supply, supply)])
    x, v, dt = np.array(system.initial_state), np.zeros(system.n_inputs), system.dt
    states = [x]
    for t in range(len(asked)):
        acted = np.zeros(system.n_inputs)
        for i in range(FINE):
            w = sent[max(0, 1 + math.floor(t + (i + 0.5) / FINE - delay))]
            half = math.exp(-dt / FINE / 2 / lag) if lag else 0.0
            acted += (w + (v - w) * half) / FINE
            v = w + (v - w) * half**2
        rate = system.derivative(x, acted, t)
        for row in system.learned_rows:
            rate[row] -= coulomb * math.tanh(x[row] / (2.0 * coulomb * dt)) if coulomb else 0.0
        x = x + dt * rate
        states.append(x)
    return np.array(states)


@pytest.mark.parametrize("name", PAPER)
@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 1.7, 2.0])
@pytest.mark.parametrize("more", [{}, {"lag": 0.03, "coulomb": 0.3}, {"lag": 0.001}])
def test_a_system_behind_hardware_moves_as_in_an_independent_simulation(
    name: str, delay: float, more: dict[str, float]
) -> None:
    system = SYSTEMS[name]()
    asked = system.gamma * np.random.default_rng(3).uniform(-1, 1, (25, system.n_inputs))
    cut = 0.6 * system.gamma
    real = Real(system, delay=delay, supply=cut, **more)
    found = simulate(real, np.clip(asked, -cut, cut)[:, None])[:, 0, : system.n_states]
    expected = simulated(system, asked, delay=delay, supply=cut, **more)
    np.testing.assert_allclose(found, expected, atol=2e-3 if more.get("lag") == 0.001 else 1e-4)
    if not more:
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def result_of(plant: dict[str, Any], env: str = "pendulum", **more: Any) -> TrialResult:
    given = trial(env, "random_held", 1, **more).to_mapping()
    return run_trial(TrialSpec.from_mapping({**given, "plant": {"name": "real", **plant}}))


def test_the_compiled_trial_takes_the_same_steps_and_records_the_cut_inputs() -> None:
    plant = {"delay": 1.7, "lag": 0.03, "coulomb": 0.2, "supply": 1.0}
    result = result_of(plant, env="arm", **{"policy": {"hold": 3}})
    system = SYSTEMS["arm"](noise=0.0, horizon=30)
    assert np.abs(result.inputs).max() == 1.0
    expected = simulated(system, result.inputs, delay=1.7, lag=0.03, coulomb=0.2)
    np.testing.assert_allclose(result.states[:, :4], expected, atol=0.01)  # with process noise
    np.testing.assert_allclose(result.states[1:, 4:6], result.inputs, atol=1e-12)


@pytest.mark.parametrize("learner", ["adam_window", "joint_ekf"])
def test_estimates_of_rounded_angles_carry_the_inputs_in_flight(learner: str) -> None:
    spec = TrialSpec.from_mapping(
        {
            "env": {"name": "pendulum", "horizon": 100, "grid_points": [4, 4]},
            "policy": {"name": "d_optimal", "regularization": 3.0},
            "model": {"name": "mlp"},
            "learner": {"name": learner},
            "plant": {"name": "real", "counts": 2048, "delay": 2.5},
        }
    )
    run, quantum = KernelTrial(spec), 2.0 * math.pi / 2048
    run.advance(100)
    outputs, true = run.state.estimate.outputs[:, 0], run.record.true_states[1:, 0]
    np.testing.assert_allclose(outputs, quantum * np.round(true / quantum), atol=1e-12)
    assert spec.system.measured_states == (0,)
    assert spec.system.measurement_noise == pytest.approx([quantum / math.sqrt(12)])
    assert run.record.loss[-1] < 0.8 * run.record.loss[0]


def test_a_section_and_a_pickle_give_the_same_system() -> None:
    for name in (*PAPER, "chain", "coupled_pendulums", "drifting_pendulum"):
        real = Real(SYSTEMS[name](), delay=1.5, lag=0.02, coulomb=0.1, supply=0.5)
        again = system_from_mapping(section_of(real))
        assert again == real == pickle.loads(pickle.dumps(real))
        assert hash(again) == hash(real)
        assert type(again) is type(real)
        assert isinstance(real, SYSTEMS[name])


def test_defaults_leave_the_system_and_its_key() -> None:
    system = Pendulum()
    assert Real(system) is system
    spec = trial("pendulum", "d_optimal")
    for plant in ({"name": "ideal"}, {"name": "real"}, {"name": "real", "delay": 0}):
        assert TrialSpec.from_mapping({**spec.to_mapping(), "plant": plant}) == spec
    late = TrialSpec.from_mapping({**spec.to_mapping(), "plant": {"name": "real", "delay": 1}})
    assert late.trial_key != spec.trial_key
    assert TrialSpec.from_mapping(late.to_mapping()).trial_key == late.trial_key
    assert late.columns()["label"] == f"{spec.columns()['label']}, delay=1"
    assert late.columns()["env"] == "pendulum"
    for more in (
        {"model": {"name": "affine"}},
        {"task": {"name": "control"}},
        {"path": "reference"},
    ):
        with pytest.raises(IncompatibleError):
            TrialSpec.from_mapping({**late.to_mapping(), **more})


@pytest.mark.parametrize("env", ["pendulum", "quadrotor"])
def test_plans_that_begin_where_the_input_arrives_are_not_blind(env: str) -> None:
    def losses(lead: int) -> float:
        found = []
        for seed in range(3):
            real = Real(SYSTEMS[env](grid_points=(8, 8), horizon=300), delay=1)
            object.__setattr__(real, "lead_steps", lead)
            constants.cache_clear()
            found.append(run_trial(TrialSpec.of_system(real, "d_optimal", seed=seed)).loss[-1])
        return float(np.exp(np.mean(np.log(found))))

    assert losses(1) < 0.8 * losses(0)
    constants.cache_clear()


@pytest.mark.parametrize(
    ("hardware", "message"),
    [
        ({"delay": -1}, "plant.delay is -1.0 samples, but it has to be finite and at least 0"),
        ({"delay": 1e6}, r"plant.delay is 1e\+06 samples, but at most 100 are expected"),
        ({"delay": math.nan}, "plant.delay is nan"),
        ({"lag": -0.1}, "plant.lag is -0.1 s"),
        ({"counts": 0}, "plant.counts is 0.0"),
        ({"coulomb": -1}, "plant.coulomb is -1.0"),
        ({"supply": 0}, "plant.supply is 0.0"),
        ({"supply": "5 V"}, "plant.supply is '5 V'"),
    ],
)
def test_values_outside_their_bounds_are_refused(hardware: Any, message: str) -> None:
    with pytest.raises(SpecificationError, match=message):
        Real(Pendulum(), **hardware)


@pytest.mark.parametrize(
    ("system", "hardware", "message"),
    [
        (Pendulum(integrator="rk4"), {"delay": 1}, "integrator 'euler' is expected"),
        (SYSTEMS["pendulum_unknown_gain"](), {"lag": 0.1}, "known effects of the inputs"),
        (SYSTEMS["mass_spring"](), {"counts": 100}, "angles that are measured one by one"),
        (Real(Pendulum(), delay=1), {"lag": 0.1}, "a system without hardware"),
    ],
)
def test_what_does_not_go_together_is_refused(system: System, hardware: Any, message: str) -> None:
    with pytest.raises(IncompatibleError, match=message):
        Real(system, **hardware)


def test_a_black_box_behind_hardware_shows_its_own_accelerations() -> None:
    pytest.importorskip("gymnasium", reason="needs the extra gymnasium")
    from tests.dopt.custom_environments import DRAG, Point

    cart = Point(id="dopt_tests/Double-v0")
    real = Real(cart, delay=1.4, lag=0.25, supply=0.5)
    assert isinstance(real, BlackBox)
    inputs = np.random.default_rng(0).uniform(-1, 1, (50, 1))
    states, applied, seen, there = transitions(real, inputs, 0)
    assert there.all()
    assert np.abs(applied).max() == 0.5
    np.testing.assert_allclose(seen[:, 0], -DRAG * states[:, 1], atol=1e-9)
    ideal = cart.episode(0)
    for w in applied:
        ideal.step(w)
    assert not np.allclose(states[-1, :2], ideal.state, atol=1e-3)
