from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from analysis.stats.geometric_means import geometric_mean
from analysis.stats.pareto import on_front

COSTS = arrays(
    float, st.tuples(st.integers(1, 12), st.integers(1, 3)), elements=st.integers(0, 5).map(float)
)  # few values, so that ties are common


def dominates(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> bool:
    return all(a <= b for a, b in zip(one, other, strict=True)) and any(
        a < b for a, b in zip(one, other, strict=True)
    )


@given(COSTS)
def test_a_choice_is_on_the_front_exactly_if_no_other_dominates_it(
    costs: npt.NDArray[np.float64],
) -> None:
    front = on_front(costs)
    assert front.any()
    for choice, is_on in zip(costs, front, strict=True):
        assert is_on == (not any(dominates(other, choice) for other in costs))


@given(COSTS)
def test_every_choice_off_the_front_is_dominated_by_one_on_it(
    costs: npt.NDArray[np.float64],
) -> None:
    front = on_front(costs)
    for choice in costs[~front]:
        assert any(dominates(member, choice) for member in costs[front])


def test_a_front_by_hand() -> None:
    costs = np.array([[1, 9], [2, 5], [2, 6], [3, 5], [4, 1], [np.nan, 0], [4, 1]])
    assert on_front(costs).tolist() == [True, True, False, False, True, False, True]


def test_nothing_has_no_front_and_no_geometric_mean() -> None:
    assert not len(on_front(np.empty((0, 2))))
    assert np.isnan(geometric_mean(np.empty(0)).value)


def test_the_interval_is_that_of_the_logarithms() -> None:
    found = geometric_mean(np.array([1.0, 10.0, 100.0]))
    half = 4.302652729911275 / np.sqrt(3)  # t quantile of 2 degrees of freedom
    assert found.value == pytest.approx(10.0)
    assert np.log10([found.low, found.high]) == pytest.approx([1 - half, 1 + half])
