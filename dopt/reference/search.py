"""Search for the best plan over a batch of trials, all plans at once (:mod:`dopt.policies.search`).

======  ==================================================  =============
symbol  meaning                                             shape
======  ==================================================  =============
J       rows along a path, in the units of M: times 1/√ρ     (..., N, q)
V       J M⁻¹                                               (..., N, q)
S       J M⁻¹ Jᵀ                                            (..., N, N)
======  ==================================================  =============
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch
from torch import Tensor
from torch.func import vmap

from dopt.algorithm import INVARIANT, TIE_MARGIN, Score, switch_step
from dopt.policies import EOptimal, Lookahead, Search, TaskOptimal
from dopt.policies.search import score_code
from dopt.policies.task_states import task_states
from dopt.reference.dynamics import LearnedDynamics
from dopt.systems.base import System


def searched_inputs(
    policy: Search,
    learned: LearnedDynamics,
    noise_variance: float,
    theta: Tensor,
    covariance: Tensor,
    x: Tensor,
    ties: Tensor,
) -> Tensor:
    """Return the first inputs of the best plans, (n, m).

    Given are parameters (n, q), M⁻¹ (n, s, s), states (n, d) and tie-breaking directions (n, m). A
    sample adds JᵀJ/ρ to M, with ρ the ``noise_variance``.
    """
    system = learned.system
    candidates = torch.tensor(policy.compared_inputs(system)).to(x)
    pairs = plans(policy, system, len(candidates))
    inputs = candidates[torch.tensor(pairs)]
    states = paths(policy, learned, theta, x, inputs)
    stride = policy.stride_of(system) if isinstance(policy, Lookahead) else 1
    seen = states[:, :, stride - 1 :: stride]
    rows = learned.rows_at(theta, seen.flatten(1, 2)).unflatten(1, seen.shape[1:3])
    rows = rows[..., : covariance.shape[1]] * noise_variance**-0.5
    if score_code(policy) == Score.JOINT:
        rows = rows * stride**0.5
    score, G = score_function(policy, learned.system), rows[:, 0, 0, :0]
    if isinstance(policy, TaskOptimal):
        wanted = torch.tensor(task_states(system, policy)).to(theta).expand(len(theta), -1, -1)
        G = learned.rows_at(theta, wanted).flatten(1, 2)[..., : covariance.shape[1]]
    values = vmap(vmap(score, (0, None, None)))(rows, G, covariance)
    inside = (states.abs() <= system.state_limit).flatten(2).all(dim=2)
    values = torch.where(inside & values.isfinite(), values, -torch.inf)
    return chosen(values, inputs[:, 0], ties)


def plans(policy: Search, system: System, count: int) -> list[tuple[int, int]]:
    """Return the plans as pairs of candidates, before and after the switch."""
    if policy.steps(system) == 1:
        return [(c, c) for c in range(count)]
    return list(itertools.product(range(count), range(count)))


def paths(
    policy: Search, learned: LearnedDynamics, theta: Tensor, x: Tensor, inputs: Tensor
) -> Tensor:
    """Return the states predicted from (n, d) under inputs (plans, 2, m): (n, plans, H, d)."""
    steps = policy.steps(learned.system)
    inputs = inputs.expand(len(x), *inputs.shape)
    states = [x.unsqueeze(1).expand(-1, inputs.shape[1], -1)]
    for i in range(steps):
        u = inputs[:, :, 0 if i < switch_step(steps) else 1]
        states.append(learned.following(theta, states[-1], u))
    return torch.stack(states[1:], dim=2)


PathScore = Callable[[Tensor, Tensor, Tensor], Tensor]


def score_function(policy: Search, system: System) -> PathScore:
    """Return the score of one path from its rows, (B, r, q), task rows G (g, q) and M⁻¹ (q, q)."""

    def joint(rows: Tensor, G: Tensor, inverse: Tensor) -> Tensor:  # noqa: ARG001  # one signature
        return _log_determinant(rows.flatten(0, 1), inverse)

    def separate(rows: Tensor, G: Tensor, inverse: Tensor) -> Tensor:  # noqa: ARG001  # one signature
        total: Tensor = vmap(_log_determinant, (0, None))(rows, inverse).sum()
        return total

    def trace(rows: Tensor, G: Tensor, inverse: Tensor) -> Tensor:  # noqa: ARG001  # one signature
        J = rows.flatten(0, 1)
        total: Tensor = ((J @ inverse) * J).sum()
        return total

    def average(rows: Tensor, G: Tensor, inverse: Tensor) -> Tensor:  # noqa: ARG001  # one signature
        total: Tensor = decrease(rows, inverse).diagonal().sum()
        return total

    def eigenvalue(rows: Tensor, G: Tensor, inverse: Tensor) -> Tensor:  # noqa: ARG001  # one signature
        assert isinstance(policy, EOptimal)
        starts = torch.tensor(policy.starts(len(inverse), system.n_learned)).to(inverse)
        Q = krylov_basis(inverse, starts, policy.subspace)
        values: Tensor = torch.linalg.eigvalsh(Q @ (inverse - decrease(rows, inverse)) @ Q.mT)
        return -values[-1]

    def task(rows: Tensor, G: Tensor, inverse: Tensor) -> Tensor:
        total: Tensor = ((G @ decrease(rows, inverse)) * G).sum()
        return total

    scores = {
        Score.JOINT: joint,
        Score.SUM: separate,
        Score.TRACE: trace,
        Score.A: average,
        Score.E: eigenvalue,
        Score.TASK: task,
    }
    return scores[score_code(policy)]


def _log_determinant(rows: Tensor, inverse: Tensor) -> Tensor:
    """Return log det(I + J M⁻¹ Jᵀ) for J, (N, q)."""
    S = rows @ inverse @ rows.mT
    value: Tensor = torch.linalg.slogdet(torch.eye(len(S)).to(S) + S)[1]
    return value


def decrease(rows: Tensor, inverse: Tensor) -> Tensor:
    """Return M⁻¹ - (M + JᵀJ)⁻¹ for the rows of J, (B, r, q)."""
    J = rows.flatten(0, 1)
    V = J @ inverse
    solved = torch.linalg.solve(torch.eye(len(J)).to(J) + V @ J.mT, V)
    lost: Tensor = V.mT @ solved
    return lost


def krylov_basis(inverse: Tensor, starts: Tensor, size: int) -> Tensor:
    """Return an orthonormal basis, (K, q), of the block Krylov space of M⁻¹ from starts, (b, q).

    Directions that add nothing are zero.
    """
    basis: list[Tensor] = []
    for j in range(min(size, len(inverse))):
        row = starts[j] if j < len(starts) else inverse @ basis[j - len(starts)]
        before = torch.linalg.vector_norm(row)
        for _ in range(2):
            for other in basis:
                row = row - (other @ row) * other
        after = torch.linalg.vector_norm(row)
        basis.append(torch.where(after > INVARIANT * before, row / after, 0.0))
    return torch.stack(basis)


def chosen(values: Tensor, first: Tensor, ties: Tensor) -> Tensor:
    """Return the first inputs, (n, m), of the best of plans with values (n, P)."""
    best = values.amax(dim=1, keepdim=True)
    equal = values >= best - TIE_MARGIN * best.abs()
    along = torch.where(equal, ties @ first.mT, -torch.inf)
    return first[along.argmax(dim=1)]
