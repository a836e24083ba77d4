"""The interval that stops a configuration covers the geometric mean as often as it says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from benchmarks.adaptive_seeds import SHAPES, coverage
from dopt.stopping.fixed_width import FEWEST_VALUES, half_width, is_narrow

STUDIES = 2_000


@pytest.mark.parametrize("shape", ["normal", "skewed", "heavy tails"])
@pytest.mark.parametrize("spread", [0.1, 0.15])
def test_at_least_95_percent_of_2000_studies_are_covered(shape: str, spread: float) -> None:
    found = coverage(SHAPES[shape], STUDIES, spread)
    assert found.value >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / STUDIES)
    assert found.seeds < 65, "it stops before all seeds are used"


def test_the_half_width_is_students() -> None:
    losses = np.exp(np.random.default_rng(0).standard_normal(30))
    logs = np.log(losses)
    low, high = stats.t.interval(0.98, 29, np.mean(logs), stats.sem(logs))
    assert half_width(losses) == pytest.approx((high - low) / 2)


def test_a_narrow_interval_needs_values_that_have_a_logarithm() -> None:
    same = np.full(FEWEST_VALUES, 2.0)
    assert is_narrow(same, 0.01)
    assert not is_narrow(same[1:], 0.01)
    assert not is_narrow(np.append(same, np.inf), 0.01)
    assert not is_narrow(np.append(same, 0.0), 0.01)
    assert not is_narrow(np.array([]), 0.01)


def test_a_wider_interval_stops_no_later() -> None:
    losses = np.exp(0.2 * np.random.default_rng(1).standard_normal(100))
    narrow = [is_narrow(losses, relative) for relative in (0.01, 0.05, 0.1, 0.5)]
    assert narrow == sorted(narrow)
    assert narrow[0] is False
    assert narrow[-1] is True
