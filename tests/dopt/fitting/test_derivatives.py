"""Derivatives that are made from text, against complex steps through the same text."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopt.fitting.model import differentiated_text
from dopt.systems.expressions import compiled_text
from dopt.types import Array

GROUPS = {"states": ["x", "y"], "inputs": ["u"], "constants": ["a", "b"]}
NAMES = [name for group in GROUPS.values() for name in group]


def deeper(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    """Return expressions of smaller ones, finite and smooth nearly everywhere."""
    forms: list[Callable[[str, str], str]] = [
        *(lambda p, q, sign=sign: f"({p} {sign} {q})" for sign in "+-*"),
        lambda p, q: f"({p} / (2 + sin({q})))",
        *(lambda p, _, name=name: f"{name}({p})" for name in ("sin", "cos", "tanh")),
        *(lambda p, _, name=name: f"{name}({p})" for name in ("magnitude", "sign", "-", "+")),
        lambda p, q: f"where({p} < {q}, {q}, sin({p}))",
        *(lambda p, _, power=power: f"tanh({p}) ** {power}" for power in (0, 1, 2, 3)),
        lambda p, q: f"(1 + magnitude(sin({p}))) ** (cos({q}) - 2)",
    ]
    return st.builds(lambda form, p, q: form(p, q), st.sampled_from(forms), inner, inner)


LEAVES = st.sampled_from([*NAMES, "0.5", "2", "1e-1"])


def written(text: str, values: Array) -> tuple[Array, Array]:
    """Return a value and its derivatives by all quantities."""
    function, where = differentiated_text([text], GROUPS, NAMES)
    value, slopes = np.zeros(1), np.zeros((1, 5))
    function(values[:2], values[2:3], values[3:], value, slopes)
    assert not slopes[~where].any()
    return value[0], slopes[0]


@settings(max_examples=200, deadline=None)
@given(st.recursive(LEAVES, deeper, max_leaves=8), st.integers(0, 2**32 - 1))
def test_derivatives_agree_with_complex_steps(text: str, seed: int) -> None:
    values = np.random.default_rng(seed).uniform(-2, 2, 5)
    equation = compiled_text({"text": text}, GROUPS)
    found, slopes = written(text, values)
    for k in range(5):
        moved = values.astype(complex)
        moved[k] += 1e-30j
        (exact,) = equation(tuple(moved[:2]), tuple(moved[2:3]), tuple(moved[3:]))
        assert found == pytest.approx(np.real(exact), rel=1e-12, abs=1e-12)
        expected = np.imag(exact) / 1e-30
        assert slopes[k] == pytest.approx(expected, rel=1e-9, abs=1e-9), NAMES[k]


@pytest.mark.parametrize(
    ("text", "slope"),
    [
        ("x ** 2", 0.0),
        ("x ** a", 0.0),
        ("magnitude(x) ** 0.5 * sign(x)", 0.0),
        ("a ** x", np.log(1.5)),
        ("y ** x", 0.0),
        ("x ** 1", 1.0),
        ("magnitude(x)", 1.0),
    ],
)
def test_a_derivative_is_a_number_at_corners_and_zeros(text: str, slope: float) -> None:
    _, slopes = written(text, np.array([0.0, -3.0, 1.0, 1.5, 2.0]))
    assert slopes[0] == slope
    assert np.isfinite(slopes).all()
