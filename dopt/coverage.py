"""Coverage: the share of the evaluation box that a trajectory visits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from dopt.evaluation import evaluation_set
from dopt.systems.base import System

Array = npt.NDArray[np.float64]

TURN = 2 * math.pi

CELLS = 20
"""Cells along each side of the box."""

Box = tuple[tuple[float, float], tuple[float, float]]


def wrap(angle: Array, centre: float = 0.0) -> Array:
    """Return angles moved by whole turns into [centre - π, centre + π)."""
    return angle - TURN * turns(angle, centre)


def turns(angle: Array, centre: float = 0.0) -> Array:
    """Return the number of whole turns between each angle and its wrapped value."""
    count: Array = np.floor((angle - centre + math.pi) / TURN)
    return count


@dataclass(frozen=True)
class Plane:
    """Phase plane of a system: state indices, labels, axes that are angles, box.

    Angles are centred on the stable equilibrium, so that small oscillations about it are not split
    at the wrap. A box that covers the whole turn moves with them.
    Where the evaluation grid has no such axis, the box is the whole turn of an angle, and otherwise
    what the reachable set spans.
    """

    axes: tuple[int, int]
    labels: tuple[str, str]
    angles: tuple[bool, bool]
    centres: tuple[float, float]
    box: Box

    @classmethod
    def of(cls, system: System) -> Self:
        """Return the phase plane of a system."""
        axes = system.phase_plane
        rest = system.equilibrium or (0.0,) * system.n_states
        angles = (axes[0] in system.angle_indices, axes[1] in system.angle_indices)
        centres = (
            rest[axes[0]] if angles[0] else 0.0,
            rest[axes[1]] if angles[1] else 0.0,
        )
        given = [_given_side(system, axis) for axis in axes]
        sides = [
            _side(side, centre) if turning else side
            for side, centre, turning in zip(given, centres, angles, strict=True)
        ]
        labels = (system.state_labels[axes[0]], system.state_labels[axes[1]])
        return cls(axes, labels, angles, centres, (sides[0], sides[1]))

    def project(self, states: Array) -> Array:
        """Return the points (n, 2) of states (n, d), angles not wrapped."""
        return states[:, list(self.axes)]

    def wrapped(self, points: Array) -> Array:
        """Return points (n, 2) with angles inside one turn around the centre."""
        inside = points.copy()
        for axis in range(2):
            if self.angles[axis]:
                inside[:, axis] = wrap(points[:, axis], self.centres[axis])
        return inside

    def coverage(self, states: Array) -> float:
        """Return the share of the box that states (n, d) visit."""
        return coverage(self.wrapped(self.project(states)), self.box)


def _given_side(system: System, axis: int) -> tuple[float, float]:
    """Return the ends of the box along a component of the state."""
    given = system.grid_box()
    if axis in given:
        return given[axis]
    if axis in system.angle_indices:
        return -math.pi, math.pi
    points = evaluation_set(system)
    reached = points.states[points.n_grid :, axis]
    return float(reached.min()), float(reached.max())


def _side(side: tuple[float, float], centre: float) -> tuple[float, float]:
    low, high = side
    if high - low > TURN - 1e-9:
        return centre - np.pi, centre + np.pi
    shift = float(wrap(np.array((low + high) / 2), centre)) - (low + high) / 2
    return low + shift, high + shift


def coverage(points: Array, box: Box, cells: int = CELLS) -> float:
    """Return the share of the cells² equal cells of a box that hold at least one of (n, 2) points.

    Angles are to be wrapped beforehand; points outside the box and NaN count nowhere.
    """
    counts, _, _ = np.histogram2d(
        points[:, 0], points[:, 1], bins=cells, range=[list(side) for side in box]
    )
    return float(np.mean(counts > 0))
