"""The error that noisy sensors leave: sensitivities, and how it moves with the sensors."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest

from benchmarks import sensor_noise
from benchmarks.sensor_noise import expected_error, sensitivities
from dopt.control.planning import predict
from dopt.randomness import initial_weights
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec

DEGREE = math.pi / 180
HORIZON = 25


def measured(noise: dict[int, float], env: str = "pendulum", **fields: object) -> TrialSpec:
    sensors = {"measured_states": list(noise), "measurement_noise": list(noise.values())}
    return TrialSpec.from_mapping(
        {
            "env": {"name": env, "horizon": HORIZON, **sensors, **fields},
            "policy": {"name": "random"},
            "model": {"name": "mlp", "width": 4},
            "learner": {"name": "joint_ekf", "refit_every": 1000},
        }
    )


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_sensitivities_are_differences_of_runs(integrator: str) -> None:
    spec = measured({0: DEGREE}, integrator=integrator)
    theta, inputs = initial_weights(spec), np.sin(np.arange(HORIZON))[:, None]
    start = np.array([[0.3, -0.2]])

    def run(parameters: np.ndarray) -> np.ndarray:
        accelerations = partial(spec.model.predict, spec.system, parameters)
        return predict(spec.system, accelerations, start, inputs[None])[:, 0]

    found = sensitivities(spec, theta, np.concatenate([start, run(theta)]), inputs)
    direction = np.random.default_rng(0).standard_normal(len(theta))
    differences = (run(theta + 1e-5 * direction) - run(theta - 1e-5 * direction)) / 2e-5
    np.testing.assert_allclose(found @ direction, differences, rtol=1e-6, atol=1e-8)
    assert np.abs(found[-1]).max() > 0.01


def test_it_falls_with_less_noise_and_with_more_sensors() -> None:
    run = run_trial(measured({0: DEGREE}))

    def of(noise: dict[int, float]) -> float:
        return expected_error(measured(noise), run.states, run.inputs)

    one, precise, both = of({0: DEGREE}), of({0: DEGREE / 10}), of({0: DEGREE, 1: 0.1})
    prior = of({0: 1e6})
    assert precise < one < prior
    assert both < one
    assert of({0: 1e8}) == pytest.approx(prior, rel=1e-9)


def test_the_question_has_a_loss_and_an_expectation_for_each_run() -> None:
    rows = sensor_noise.measure(quick=True)
    assert len(rows) == 6
    planned, least, _, _, known, none = (row.value or 0.0 for row in rows)
    assert known < 0.2 * least
    assert planned == pytest.approx(least, rel=0.3)
    assert none > 3 * known
