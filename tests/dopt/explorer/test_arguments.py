"""Arguments of other types: NumPy's numbers are taken, others are refused in one sentence."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dopt
from dopt import Explorer
from dopt.errors import SpecificationError
from tests.dopt.explorer.plants import MOTOR
from tests.dopt.explorer.saves import drive, explorer


def test_numbers_of_numpy_describe_the_same_exploration() -> None:
    plain: dict[str, Any] = {"gamma": 6, "dt": 0.25, "box": {"rate": 30}, "limit": 1000}
    numpy = {
        "gamma": np.int64(6),
        "dt": np.float32(0.25),
        "box": {"rate": np.int64(30)},
        "limit": np.int64(1000),
        "velocity_cutoff": np.float32(2.0),
        "constants": {"gain": np.float32(5.0)},
    }
    expected = Explorer(dataclasses.replace(MOTOR, **plain), steps=10, seed=3)
    given = Explorer(
        dataclasses.replace(MOTOR, **numpy),
        steps=np.int64(10),
        seed=np.int64(3),
        tolerance=np.float32(0.5),
        model={"name": "mlp", "width": np.int64(16)},
    )
    assert given.spec.trial_key == expected.spec.trial_key
    assert given.spec.to_mapping() == expected.spec.to_mapping()


@pytest.mark.parametrize("steps", [2.5, 0, -1, True, "5", None, 10**8, 10**30, np.float64(5.0)])
def test_steps_that_are_no_number_of_steps(steps: Any) -> None:
    with pytest.raises(SpecificationError, match=r"^steps is .* from 1 to 10,000,000 is expected"):
        Explorer(MOTOR, steps=steps)


@pytest.mark.parametrize(
    "plant",
    ["pendulum", {"name": "pendulum"}, dopt.Plant, dopt.SYSTEMS["pendulum"], None],
)
def test_a_plant_that_is_none(plant: Any) -> None:
    with pytest.raises(SpecificationError, match=r"^plant is .*, but a plant or a system"):
        Explorer(plant)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"policy": None}, "'policy' is None"),
        ({"learner": None}, "'learner' is None"),
        ({"model": 5}, "'model' is 5"),
        ({"journal": 5}, "journal is 5, but the path of a file"),
        ({"deadline": 1e12}, "deadline is 1000000000000.0, but a number above 0 and below"),
        ({"deadline": [1.0, [2.0]]}, "deadline is"),
    ],
)
def test_settings_of_another_type(given: dict[str, Any], said: str) -> None:
    with pytest.raises(SpecificationError, match=said):
        Explorer(MOTOR, **given)


STATES = np.cumsum(np.ones((101, 2)), axis=0)
INPUTS = np.ones((100, 1))

NO_NUMBERS: list[Any] = ["a", [[1.0, 2.0], [3.0]], [1j, 2.0], None, {}, [["a", "b"]]]


@pytest.mark.parametrize("given", NO_NUMBERS)
def test_states_that_are_no_numbers(given: Any) -> None:
    one = Explorer(MOTOR, steps=5)
    with pytest.raises(SpecificationError, match="an array of real numbers is expected"):
        one.predict(given)
    with pytest.raises(SpecificationError, match="an array of real numbers is expected"):
        one.free_run_error(given, INPUTS)
    with pytest.raises(SpecificationError, match="an array of real numbers is expected"):
        one.free_run_error(STATES, given)


@pytest.mark.parametrize("steps", [2.5, "5", True, None])
def test_predictions_of_another_number_of_steps(steps: Any) -> None:
    with pytest.raises(SpecificationError, match=r"^steps is .*a whole number"):
        Explorer(MOTOR, steps=5).free_run_error(STATES, INPUTS, steps)
    with pytest.raises(SpecificationError, match=r"shape \(1,\)"):
        Explorer(MOTOR, steps=5).free_run_error(5, 5)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_test_run_that_has_no_error_is_refused_and_not_stored(
    value: float, tmp_path: Path
) -> None:
    url, states, inputs = f"sqlite:///{tmp_path}/results.db", STATES.copy(), INPUTS.copy()
    with explorer() as run:
        drive(run, 5)
        states[3, 0] = inputs[7, 0] = value
        with pytest.raises(SpecificationError, match=r"states of row 3 .* finite numbers"):
            run.save(url, test=(states, INPUTS))
        with pytest.raises(SpecificationError, match=r"inputs of row 7 .* finite numbers"):
            run.save(url, test=(STATES, inputs))
        with pytest.raises(SpecificationError, match="in which nothing changes"):
            run.save(url, test=(np.zeros((101, 2)), INPUTS))
        assert np.isfinite(run.free_run_error(STATES, INPUTS, np.int64(20)))
