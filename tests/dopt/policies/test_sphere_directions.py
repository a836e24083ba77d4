"""Directions lie on the sphere, are always the same and are spread over it evenly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopt.errors import SpecificationError
from dopt.policies.search import LARGEST_REPELLED, sphere_directions


@pytest.mark.parametrize("m", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("count", [1, 2, 8, 33, LARGEST_REPELLED + 1])
def test_directions_are_unit_vectors_and_always_the_same(m: int, count: int) -> None:
    found = sphere_directions(m, count)
    assert found.shape == (2 if m == 1 else count, m)
    assert np.linalg.norm(found, axis=1) == pytest.approx(1.0, rel=1e-12)
    assert np.array_equal(found, sphere_directions.__wrapped__(m, count))


@given(st.integers(1, 6), st.integers(1, 40))
def test_no_direction_comes_twice(m: int, count: int) -> None:
    found = sphere_directions(m, count)
    assert len(np.unique(found.round(9), axis=0)) == len(found)


def test_one_input_has_two_directions() -> None:
    assert sphere_directions(1, 16).tolist() == [[1.0], [-1.0]]


@pytest.mark.parametrize("count", [7, 16])
def test_two_inputs_have_directions_at_equal_angles(count: int) -> None:
    found = sphere_directions(2, count)
    cos, sin = np.cos(2 * np.pi / count), np.sin(2 * np.pi / count)
    turned = found @ np.array([[cos, sin], [-sin, cos]])
    assert turned == pytest.approx(np.roll(found, -1, axis=0), abs=1e-12)


@pytest.mark.parametrize(
    ("m", "count", "best"),
    [
        (3, 4, np.arccos(-1 / 3)),
        (3, 6, np.pi / 2),
        (3, 12, np.arccos(1 / 5**0.5)),
        (4, 8, np.pi / 2),
    ],
)
def test_more_inputs_have_directions_nearly_as_far_apart_as_can_be(
    m: int, count: int, best: float
) -> None:
    """Tetrahedron, octahedron, icosahedron and 16-cell are the optimal codes of their size."""
    found = sphere_directions(m, count)
    angles = np.arccos(np.clip(found @ found.T - 2 * np.eye(count), -1, 1))
    assert angles.min() > 0.9 * best


@pytest.mark.parametrize("count", [64, 20_000])
def test_more_inputs_prefer_no_direction(count: int) -> None:
    found = sphere_directions(4, count)
    assert found.mean(axis=0) == pytest.approx(0.0, abs=0.01)
    assert np.cov(found.T, bias=True) == pytest.approx(np.eye(4) / 4, abs=0.01)


@pytest.mark.parametrize(("m", "count"), [(0, 8), (3, 0), (2, -1)])
def test_a_number_below_one_is_answered_by_one_sentence(m: int, count: int) -> None:
    message = (
        rf"{count} directions of {m} inputs are asked for, but .* expected: give two whole .*\.$"
    )
    with pytest.raises(SpecificationError, match=message):
        sphere_directions(m, count)
