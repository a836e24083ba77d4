"""Scores of whole plans in compiled code, other than the determinant that grows along the path."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import Score
from dopt.kernel.compiler import compiled, squared, vectorized
from dopt.kernel.information.primal import inner
from dopt.kernel.points import n_next_points, next_points
from dopt.kernel.search.krylov import krylov_space, largest_eigenvalue
from dopt.kernel.search.path import Path, Place, row_at, rows_of_points, whitened
from dopt.kernel.state_structs import Covariance
from dopt.kernel.structs import Network, Plant, Search
from dopt.types import Matrix, Vector


class ScoreContext(NamedTuple):
    """Arrays that a score needs beside the path; empty where it needs none."""

    probes: Matrix  # (n, q), J at the task's states or the basis of the Krylov space
    projected: Matrix  # (K, K), M⁻¹ in the Krylov space


@vectorized
def score_of_path(score: int, path: Path, place: Place, context: ScoreContext) -> float:
    """Return the score of a whole path whose factor is known, if it is not a determinant."""
    n, total = path.factor.shape[0], 0.0
    if score == Score.TRACE:
        for i in range(n):
            at = row_at(place, i)
            total += inner(path.products[at], path.rows[at])
        return total
    white = whitened(path, place)
    if score == Score.E:
        return -largest_eigenvalue(context.projected, context.probes, white)
    for i in range(n):
        if score == Score.A:
            total += inner(white[i], white[i])
        for j in range(context.probes.shape[0]):
            total += squared(inner(white[i], context.probes[j]))
    return total


@compiled
def score_context(
    plant: Plant, network: Network, search: Search, theta: Vector, covariance: Covariance
) -> ScoreContext:
    """Return what the score needs at these parameters and this M⁻¹."""
    if search.score == Score.E:
        basis, projected = krylov_space(covariance, search.starts, search.subspace)
        return ScoreContext(basis, projected)
    n = search.task_states.shape[0] if search.score == Score.TASK else 0
    per_state = n_next_points(network)
    points = np.empty((n * per_state, search.task_states.shape[1] + network.n_inputs_read))
    for s in range(n):
        at = next_points(network, search.task_states[s], plant.gamma)
        points[s * per_state : (s + 1) * per_state] = at
    return ScoreContext(rows_of_points(plant, network, theta, points), np.empty((0, 0)))
