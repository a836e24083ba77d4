"""Names of parameters that a custom system lacks, and equations without numbers, are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt.errors import SpecificationError
from dopt.spec.custom_system import check_system
from dopt.systems.elementary import where
from tests.dopt.spec.test_custom_system_check import broken


def quadratic(state: Any, parameters: Any) -> tuple[Any, ...]:
    return (-(parameters[3] ** 2) * state[1],)


def divided(state: Any, parameters: Any) -> tuple[Any, ...]:
    return (-state[1] / parameters[3],)


def of_the_product(state: Any, parameters: Any) -> tuple[Any, ...]:
    return (-parameters[1] * parameters[3] * state[1],)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("attributes", "sentence"),
    [
        (
            {"linear_parameters": ("frition",)},
            r"linear_parameters of env 'pendulum' names 'frition', .* did you mean 'friction'",
        ),
        (
            {"physical": ("mass", "lenth", "gravity", "friction")},
            r"physical of env 'pendulum' names 'lenth', but Broken has no attr.* lenth: float = pa",
        ),
        ({"accelerations": quadratic, "linear_parameters": ("friction",)}, "not affine in them"),
        ({"accelerations": divided, "linear_parameters": ("friction",)}, "not affine in them"),
        (
            {"accelerations": of_the_product, "linear_parameters": ("length", "friction")},
            r"linear_parameters of env 'pendulum' are length, friction, but .* not affine in them",
        ),
    ],
)
def test_wrong_names_of_parameters_are_refused(attributes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        check_system(broken(**attributes))


def test_a_product_is_affine_in_each_parameter_alone() -> None:
    check_system(broken(accelerations=of_the_product, linear_parameters=("friction",)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("attributes", "sentence"),
    [
        (
            {"accelerations": lambda state, *_: (1.0 / state[1],), "compiled": False},
            r"^accelerations\(\) of env 'pendulum' gives inf for the derivative of .* at the "
            r"initial state, .* = 0.001, .* = 0, but a finite number is expected: .*initial_state",
        ),
        (
            {"accelerations": lambda state, *_: ((state[1] + 1.5) ** 0.5,)},
            r"gives nan .* at a state of the evaluation grid, .* = -.*, .* env\.grid_half_widths",
        ),
        (
            {"known": lambda state, inputs, *_: (state[1], inputs[0] / state[1])},
            r"^known\(\) of env 'pendulum' gives nan .* at the initial state",
        ),
    ],
)
def test_equations_without_numbers_are_refused(attributes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        check_system(broken(**attributes))


@pytest.mark.filterwarnings("error")
def test_a_pole_that_no_trial_begins_at_and_no_grid_has_is_accepted() -> None:
    check_system(broken(accelerations=lambda state, *_: (where(state[1] > 50, np.inf, 0.0),)))
