from __future__ import annotations

import numpy as np

from dopt.coverage import coverage

BOX = ((-1.0, 1.0), (0.0, 4.0))


def test_one_cell_of_four() -> None:
    assert coverage(np.array([[-0.5, 1.0], [-0.6, 1.1]]), BOX, cells=2) == 0.25


def test_a_point_in_every_cell_is_everything() -> None:
    x, y = np.meshgrid(np.linspace(-0.95, 0.95, 20), np.linspace(0.1, 3.9, 20))
    assert coverage(np.stack([x.ravel(), y.ravel()], axis=1), BOX) == 1.0


def test_points_outside_and_after_a_divergence_count_nowhere() -> None:
    points = np.array([[-1.5, 1.0], [0.5, 5.0], [np.nan, np.nan], [0.5, np.nan]])
    assert coverage(points, BOX, cells=4) == 0.0
