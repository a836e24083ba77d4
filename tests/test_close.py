"""The comparison of large arrays says what that of pytest says."""

from __future__ import annotations

import numpy as np
import pytest

from tests.close import assert_close

EXPECTED = np.array([[1.0, -2.0], [0.0, 1e6]])
TOLERANCES = [(None, None), (1e-3, None), (None, 1e-3), (1e-3, 1e-1), (0.0, 1e-3), (1e-3, 0.0)]
GAPS = [0.0, 9e-13, 1.1e-12, 9e-7, 1.1e-6, 9e-4, 1.1e-3, 9e-2, 1.1e-1, -9e-4, -1.1e-3, 9e2, 1.1e3]


def agrees(values: np.ndarray, expected: np.ndarray, **tolerances: float | None) -> bool:
    try:
        assert_close(values, expected, **tolerances)
    except AssertionError:
        return False
    return True


@pytest.mark.parametrize(("rel", "absolute"), TOLERANCES)
@pytest.mark.parametrize("place", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_it_agrees_with_pytest(
    place: tuple[int, int], rel: float | None, absolute: float | None
) -> None:
    answers = set()
    for gap in GAPS:
        values = EXPECTED.copy()
        values[place] += gap
        found = agrees(values, EXPECTED, rel=rel, abs=absolute)
        assert found == (values == pytest.approx(EXPECTED, rel=rel, abs=absolute)), gap
        answers.add(found)
    assert answers == {True, False}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_left_to_pytest(value: float) -> None:
    other = EXPECTED.copy()
    other[0, 0] = value
    assert not agrees(other, EXPECTED)
    assert not agrees(EXPECTED, other)
    assert agrees(other, other) == (not np.isnan(value))


def test_another_shape_is_not_close() -> None:
    assert not agrees(EXPECTED, EXPECTED[0])
    assert not agrees(EXPECTED[:, :1], EXPECTED)
