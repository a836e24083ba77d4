"""Scores of whole plans in compiled code, other than the determinant that grows along the path."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import Score
from dopt.kernel.compiler import compiled, squared, vectorized
from dopt.kernel.information.primal import inner
from dopt.kernel.search.krylov import krylov_space, largest_eigenvalue
from dopt.kernel.search.path import Path, model_and_jacobian, rows_of_state, whiten
from dopt.kernel.state_structs import Covariance
from dopt.kernel.structs import Network, Plant, Search
from dopt.types import Matrix, Vector


class ScoreContext(NamedTuple):
    """Arrays that a score needs beside the path; empty where it needs none."""

    probes: Matrix  # (n, q), J at the task's states or the basis of the Krylov space
    projected: Matrix  # (K, K), M⁻¹ in the Krylov space


@vectorized
def score_of_path(score: int, path: Path, context: ScoreContext) -> float:
    """Return the score of a whole path whose factor is known, if it is not a determinant."""
    n, total = path.products.shape[0], 0.0
    if score == Score.TRACE:
        for i in range(n):
            total += inner(path.products[i], path.rows[i])
        return total
    whiten(path, n)
    if score == Score.E:
        return -largest_eigenvalue(context.projected, context.probes, path.products)
    for i in range(n):
        if score == Score.A:
            total += inner(path.products[i], path.products[i])
        for j in range(context.probes.shape[0]):
            total += squared(inner(path.products[i], context.probes[j]))
    return total


@compiled
def score_context(
    plant: Plant,
    network: Network,
    search: Search,
    theta: Vector,
    covariance: Covariance,
    path: Path,
) -> ScoreContext:
    """Return what the score needs at these parameters and this M⁻¹."""
    q, R = theta.shape[0], rows_of_state(plant, network)
    if search.score == Score.E:
        basis, projected = krylov_space(covariance, search.starts, search.subspace)
        return ScoreContext(basis, projected)
    n = search.task_states.shape[0] if search.score == Score.TASK else 0
    rows = np.empty((n * R, q))
    for s in range(n):
        for i in range(path.flow.shape[0]):
            path.states[0, i] = search.task_states[s, i]
        model_and_jacobian(plant, network, theta, path, 0, rows[s * R : (s + 1) * R])
    return ScoreContext(rows, np.empty((0, 0)))
