"""Looks are few, evenly spaced and end at the maximum."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.stopping.looks import FEWEST_SEEDS, MOST_LOOKS, looks


@pytest.mark.parametrize("maximum", [1, 9, 10, 11, 25, 100, 199, 200, 201, 1000, 12_345])
def test_looks_are_spaced_evenly_up_to_the_maximum(maximum: int) -> None:
    found = looks(maximum)
    assert found[-1] == maximum
    assert len(found) <= MOST_LOOKS
    steps = np.diff([0, *found])
    assert np.all(steps > 0)
    assert len(set(steps[:-1])) <= 1, "only the last one may be shorter"
    assert steps[-1] <= steps[0]
    assert all(step % FEWEST_SEEDS == 0 for step in steps[:-1])


def test_a_hundred_seeds_are_looked_at_ten_times() -> None:
    assert looks(100) == list(range(10, 101, 10))
