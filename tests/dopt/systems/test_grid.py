from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopt.errors import SpecificationError
from dopt.systems import SYSTEMS, Chain
from tests.dopt.systems.strategies import NAMES

full = pytest.mark.parametrize(
    "name", [name for name in NAMES if not SYSTEMS[name].low_discrepancy]
)


@full
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


@full
def test_the_mean_over_the_grid_tends_to_the_mean_over_the_box(name: str) -> None:
    cls = SYSTEMS[name]
    widths = np.array(cls().grid_half_widths)
    exact = np.prod(np.sin(widths / 3) / (widths / 3))
    errors = []
    for n in (8, 16):
        grid = cls(grid_points=(n,) * len(widths)).grid()[:, list(cls.grid_indices)]
        errors.append(abs(np.cos(grid / 3).prod(axis=1).mean() - exact))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.5)


@settings(max_examples=20)
@given(st.integers(1, 4), st.integers(0, 9))
def test_a_low_discrepancy_set_takes_every_midpoint_of_every_axis_once(
    n_links: int, exponent: int
) -> None:
    n = 2**exponent
    chain = Chain(n_links=n_links, grid_points=(n,), grid_half_widths=(1.5, 4.0))
    grid = chain.grid()
    assert grid.shape == (n, 2 * n_links)
    for column, width in zip(grid.T, chain.grid_half_widths, strict=True):
        midpoints = (2 * np.arange(n) + 1 - n) / n * width
        assert np.sort(column) == pytest.approx(midpoints, abs=1e-12)


def test_a_low_discrepancy_set_is_closer_to_the_mean_over_the_box_than_random_points() -> None:
    widths = np.array([1.0, 2.0] * 5)
    exact = np.prod(np.sin(widths / 3) / (widths / 3))
    random = np.random.default_rng(0).uniform(-widths, widths, (100, 1024, 10))
    grid = Chain(grid_points=(1024,), grid_half_widths=(1.0, 2.0)).grid()
    errors = np.abs(np.cos(random / 3).prod(axis=-1).mean(axis=1) - exact)
    assert abs(np.cos(grid / 3).prod(axis=1).mean() - exact) < 0.1 * np.median(errors)


def test_the_number_of_points_of_a_low_discrepancy_set_is_a_power_of_two() -> None:
    with pytest.raises(
        SpecificationError, match=r"grid_points is \[1000\], .* set it to 512 or 1024"
    ):
        Chain(grid_points=(1000,))
