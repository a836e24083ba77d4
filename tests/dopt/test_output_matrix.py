"""Measured outputs y = C x + v that mix states."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt.errors import IncompatibleError, SpecificationError
from dopt.explorer import Explorer
from dopt.run import run_trial
from tests.dopt.test_sensors import ABSOLUTE, ANGLE, CART, DEGREE, JOINTS, sensed


def test_a_matrix_that_selects_states_measures_them() -> None:
    rows = {"output_matrix": [0, 0, 1, 0, 1, 0, 0, 0], "measurement_noise": [DEGREE, 0.01]}
    selected, given = (
        run_trial(sensed("cartpole", sensors, horizon=20)) for sensors in (CART, rows)
    )
    assert np.array_equal(selected.inputs, given.inputs)
    assert np.array_equal(selected.parameters, given.parameters)


def test_the_matrix_of_the_outputs_is_part_of_the_key() -> None:
    changed = ABSOLUTE | {"output_matrix": [1, 0, 0, 0, 1, 0, 2, 0]}
    specs = [sensed("arm", sensors) for sensors in (JOINTS, ABSOLUTE, changed)]
    assert len({spec.trial_key for spec in specs}) == 3
    assert len({spec.config_key for spec in specs}) == 3


def test_outputs_that_mix_states_tell_the_state() -> None:
    """By the absolute angles of its links an arm is known as well as by those of its joints."""
    errors = []
    for sensors in (JOINTS, ABSOLUTE):
        result = run_trial(sensed("arm", sensors, horizon=200, noise_variance=10.0))
        assert result.estimated_states is not None
        errors.append(np.sqrt(np.mean((result.estimated_states - result.states)[20:, ::2] ** 2)))
    assert max(errors) < DEGREE  # less than a single measurement is off
    assert errors[1] < 1.5 * errors[0]


REFUSED = [
    (ANGLE | {"output_matrix": [1.0, 0.0]}, "one of the two is expected"),
    ({"output_matrix": [1.0], "measurement_noise": [0.1]}, "needs 2 for each output"),
    ({"output_matrix": [0, 0], "measurement_noise": [0.1]}, "no row of 2 zeros"),
    ({"output_matrix": [1, 1]}, "measurement_noise has 0 entries, but pendulum needs 1"),
]


@pytest.mark.parametrize(("sensors", "said"), REFUSED)
def test_matrices_that_make_no_sense_are_refused(sensors: dict[str, Any], said: str) -> None:
    with pytest.raises(SpecificationError, match=said):
        sensed("pendulum", sensors)


def test_what_estimates_no_states_is_refused() -> None:
    mixed = {"output_matrix": [1, 0.1], "measurement_noise": [0.1]}
    with pytest.raises(IncompatibleError, match=r"output_matrix goes with .* 'joint_ekf'"):
        sensed("pendulum", mixed, "adam")
    with pytest.raises(SpecificationError, match="an explorer is told states"):
        Explorer(sensed("pendulum", mixed).system, learner="joint_ekf")
