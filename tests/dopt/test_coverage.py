from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import numpy as np
import pytest

from dopt.assessment import Plane, coverage
from dopt.evaluation import reachable_states
from dopt.systems import Cartpole

BOX = ((-1.0, 1.0), (0.0, 4.0))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Turned(Cartpole):
    """Looked at from the cart."""

    phase_plane: ClassVar[tuple[int, int]] = (0, 1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Round(Turned):
    """On a track that is closed."""

    angle_indices: ClassVar[tuple[int, ...]] = (0, 2)


def test_one_cell_of_four() -> None:
    assert coverage(np.array([[-0.5, 1.0], [-0.6, 1.1]]), BOX, cells=2) == 0.25


def test_a_point_in_every_cell_is_everything() -> None:
    x, y = np.meshgrid(np.linspace(-0.95, 0.95, 20), np.linspace(0.1, 3.9, 20))
    assert coverage(np.stack([x.ravel(), y.ravel()], axis=1), BOX) == 1.0


def test_points_outside_and_after_a_divergence_count_nowhere() -> None:
    points = np.array([[-1.5, 1.0], [0.5, 5.0], [np.nan, np.nan], [0.5, np.nan]])
    assert coverage(points, BOX, cells=4) == 0.0


def test_an_axis_on_which_nothing_is_judged_has_what_can_be_reached() -> None:
    """As of a boat, whose drag does not depend on where it is."""
    cart = Turned()
    assert 0 not in cart.grid_indices, "its position"
    reached = reachable_states(cart)[:, 0]
    plane = Plane.of(cart)
    assert plane.box == ((reached.min(), reached.max()), cart.grid_box()[1])
    assert plane.coverage(reachable_states(cart)) > 0.1


def test_an_angle_on_which_nothing_is_judged_has_a_whole_turn() -> None:
    assert Plane.of(Round()).box[0] == pytest.approx((-math.pi, math.pi))
