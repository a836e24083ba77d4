from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopt.planning.candidates import sphere_candidates


@given(st.integers(1, 6), st.integers(1, 40), st.floats(0.1, 10.0))
def test_candidates_lie_on_the_sphere_in_opposite_pairs(m: int, count: int, radius: float) -> None:
    inputs = sphere_candidates(m, count, radius)
    assert inputs.shape[1] == m
    assert np.linalg.norm(inputs, axis=1) == pytest.approx(radius)
    half = len(inputs) // 2
    assert np.array_equal(inputs[half:], -inputs[:half])
    assert len(np.unique(inputs.round(9), axis=0)) == len(inputs)
    if m > 1:
        assert len(inputs) == max(2 * m, 2 * ((count + 1) // 2))


def test_one_input_has_two_candidates() -> None:
    assert sphere_candidates(1, 16, 2.0).tolist() == [[2.0], [-2.0]]


def test_two_inputs_are_directions_evenly_round_the_circle() -> None:
    inputs = sphere_candidates(2, 16, 1.0)
    angles = np.sort(np.arctan2(inputs[:, 1], inputs[:, 0]))
    assert np.diff(angles) == pytest.approx(2 * np.pi / 16)


def test_more_inputs_are_drawn_without_a_direction_but_always_the_same() -> None:
    inputs = sphere_candidates(4, 20_000, 1.0)
    assert np.array_equal(inputs, sphere_candidates(4, 20_000, 1.0))
    assert np.cov(inputs.T) == pytest.approx(np.eye(4) / 4, abs=0.01)
