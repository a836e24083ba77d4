"""Elementary functions mean the same for numbers, arrays, tensors and compiled code."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from dopt.errors import SpecificationError
from dopt.kernel.equations import compiled_equations
from dopt.spec.custom_system import check_system
from dopt.systems.elementary import cos, magnitude, sign, sin, tanh, where
from tests.dopt.spec.test_custom_system_check import broken

Function = Callable[[Any], Any]

FUNCTIONS: dict[str, Function] = {
    "sin": sin,
    "cos": cos,
    "tanh": tanh,
    "magnitude": magnitude,
    "sign": sign,
    "where": lambda x: where(x > 0, 2.0 * x, x * x),
    "where with constants": lambda x: where(x > 0.5, 1.0, -3.0),
    "where at most": lambda x: where(x <= 0.5, x, -x),
}
POINTS = (-1.3, -0.2, 0.4, 2.0)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_arrays_and_tensors_agree_with_numbers(name: str) -> None:
    function = FUNCTIONS[name]
    numbers = [function(x) for x in POINTS]
    assert all(isinstance(number, float) for number in numbers)
    np.testing.assert_allclose(function(np.array(POINTS)), numbers, rtol=1e-15)
    tensor = function(torch.tensor(POINTS, dtype=torch.float64))
    np.testing.assert_allclose(tensor.numpy(), numbers, rtol=1e-15)


def slope(function: Function, x: float) -> float:
    return float((function(x + 1e-6) - function(x - 1e-6)) / 2e-6)


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("x", POINTS)
def test_a_complex_step_takes_the_derivative(name: str, x: float) -> None:
    function, step = FUNCTIONS[name], 1e-30
    for value in (np.complex128(x + 1j * step), np.array([x + 1j * step])):
        found = np.asarray(function(value)).imag / step
        assert float(np.ravel(found)[0]) == pytest.approx(slope(function, x), abs=1e-8)


def test_the_sign_of_zero_is_zero_and_of_nan_is_nan() -> None:
    assert sign(0.0) == 0.0
    assert sign(np.complex128(0.0 + 1e-30j)) == 0.0
    assert math.isnan(sign(math.nan))


FRICTION: dict[str, Callable[[Any, Any], Any]] = {
    "sign": lambda state, parameters: (-parameters[3] * sign(state[1]) - sin(state[0]),),
    "where": lambda state, parameters: (where(state[1] > 0, -parameters[3], 2.0 * state[1]),),
    "product": lambda state, parameters: ((state[1] > 0) * -parameters[3] - state[1],),
}


@pytest.mark.parametrize("name", FRICTION)
def test_dry_friction_is_compiled_with_its_derivative(name: str) -> None:
    system, out = broken(accelerations=FRICTION[name]), np.empty(1)
    check_system(system)
    equations, parameters = compiled_equations(system), np.array(system.parameters)
    slopes = np.empty(1, complex)
    for rate in (-0.7, 0.3):
        state = np.array([0.5, rate])
        equations.accelerations(state, parameters, out)
        expected = system.accelerations(tuple(state), system.parameters)
        np.testing.assert_allclose(out, expected, rtol=1e-14)
        equations.complex_accelerations(state + 1e-30j * np.eye(2)[1], parameters + 0j, slopes)
        ahead, behind = (
            system.accelerations((0.5, rate + h), system.parameters)[0] for h in (1e-6, -1e-6)
        )
        assert slopes[0].imag / 1e-30 == pytest.approx((ahead - behind) / 2e-6, abs=1e-6)


@pytest.mark.parametrize(
    "function", [lambda state, *_: (-np.sign(state[1]),), lambda state, *_: (-abs(state[1]),)]
)
def test_a_wrong_derivative_is_refused(function: Callable[..., Any]) -> None:
    with pytest.raises(SpecificationError, match="use sign, where and magnitude") as caught:
        check_system(broken(accelerations=function))
    assert "\n" not in str(caught.value)


def unknown_to_the_compiler(state: Any, parameters: Any) -> tuple[Any, ...]:  # noqa: ARG001
    return (sum({"rate": -state[1]}.values()),)


def test_equations_that_do_not_compile_are_refused_in_a_sentence() -> None:
    system = broken(accelerations=unknown_to_the_compiler)
    check_system(system)
    with pytest.raises(SpecificationError, match="does not compile") as caught:
        compiled_equations(system)
    message = str(caught.value)
    assert "unknown_to_the_compiler of test_elementary.py" in message
    assert "\n" not in message
    assert len(message) < 500
