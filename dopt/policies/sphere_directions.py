"""Finite sets of unit input directions, for policies that compare candidate inputs."""

from __future__ import annotations

import functools
from statistics import NormalDist

import numpy as np

from dopt.errors import SpecificationError
from dopt.policies.base import Array, on_sphere

LARGEST_REPELLED = 256
"""More points than these stay where the sequence has them: repulsion takes their number squared."""

_REPULSIONS = 400


@functools.lru_cache(maxsize=16)
def sphere_directions(n_inputs: int, count: int) -> Array:
    """Return unit vectors, (C, m), spread well over the sphere; the same at every call.

    For m = 1 these are ±1, for m = 2 equal angles from the first axis. Otherwise points of a
    low-discrepancy sequence (M. Roberts, "The unreasonable effectiveness of quasirandom sequences",
    2018) repel each other as charges do.

    Parameters
    ----------
    n_inputs : int
        m.
    count : int
        C, odd or even. One input has two directions, whatever the count.

    Raises
    ------
    SpecificationError
        If either number is below 1.
    """
    if n_inputs < 1 or count < 1:
        raise SpecificationError(
            f"{count} directions of {n_inputs} inputs are asked for, but at least 1 direction of "
            f"at least 1 input is expected: give two whole numbers above 0."
        )
    if n_inputs == 1:
        return np.array([[1.0], [-1.0]])
    if n_inputs == 2:
        angles = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = _quasirandom(n_inputs, count)
    return _repelled(points) if count <= LARGEST_REPELLED else points


def _quasirandom(m: int, count: int) -> Array:
    """Return points on the unit sphere, (count, m), from a Kronecker sequence in the cube."""
    root = 2.0
    for _ in range(50):  # the positive root of x^(m + 1) = x + 1
        root = (1.0 + root) ** (1.0 / (m + 1))
    cube = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, m + 1))) % 1.0
    return on_sphere(np.vectorize(NormalDist().inv_cdf)(cube), 1.0)


def _repelled(points: Array) -> Array:
    """Return points on the unit sphere, (C, m), moved apart by forces of one over distance²."""
    count, m = points.shape
    for i in range(_REPULSIONS):
        gaps = points[:, None] - points
        distances = np.linalg.norm(gaps, axis=-1) + np.eye(count)
        force = (gaps / distances[..., None] ** 3).sum(axis=1)
        force -= (force * points).sum(axis=1, keepdims=True) * points
        largest = np.linalg.norm(force, axis=1).max() + 1e-300
        step = (1 - i / _REPULSIONS) * count ** (-1 / (m - 1))
        points = on_sphere(points + step / (2 * largest) * force, 1.0)
    return points
