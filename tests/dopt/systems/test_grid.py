from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopt.systems import SYSTEMS
from tests.dopt.systems.strategies import NAMES

pytestmark = pytest.mark.parametrize("name", NAMES)


@given(data=st.data())
def test_the_grid_fills_its_box_evenly(name: str, data: st.DataObject) -> None:
    cls = SYSTEMS[name]
    axes = len(cls.grid_indices)
    counts = tuple(data.draw(st.lists(st.integers(1, 5), min_size=axes, max_size=axes)))
    widths = tuple(data.draw(st.lists(st.floats(0.1, 9.0), min_size=axes, max_size=axes)))
    system = cls(grid_points=counts, grid_half_widths=widths)
    grid = system.grid()
    assert grid.shape == (math.prod(counts), system.n_states)
    assert len(np.unique(grid, axis=0)) == len(grid)
    for index, count, width in zip(cls.grid_indices, counts, widths, strict=True):
        cells = (grid[:, index] + width) / (2 * width) * count
        assert cells - np.floor(cells) == pytest.approx(0.5)
        assert np.bincount(np.floor(cells).astype(int)).tolist() == [len(grid) // count] * count
    others = [i for i in range(system.n_states) if i not in cls.grid_indices]
    assert not grid[:, others].any()


def test_the_mean_over_the_grid_tends_to_the_mean_over_the_box(name: str) -> None:
    cls = SYSTEMS[name]
    widths = np.array(cls().grid_half_widths)
    exact = np.prod(np.sin(widths / 3) / (widths / 3))
    errors = []
    for n in (8, 16):
        grid = cls(grid_points=(n,) * len(widths)).grid()[:, list(cls.grid_indices)]
        errors.append(abs(np.cos(grid / 3).prod(axis=1).mean() - exact))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.5)
