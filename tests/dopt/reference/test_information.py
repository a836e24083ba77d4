"""The information of a batch against fresh factorisations of M."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dopt.reference.batch import Lockstep
from dopt.reference.information import MOST_ROOTS, SMALL, BatchInformation
from tests.dopt.trials import trial

SIZES = (7, SMALL, SMALL + 1, 150)


def gap(found: Tensor, expected: Tensor) -> float:
    return float((found - expected).abs().max() / expected.abs().max())


def random_rows(n: int, r: int, s: int, rng: torch.Generator) -> Tensor:
    """Return rows whose columns differ in scale by a factor of up to a thousand."""
    scales = torch.logspace(-1.5, 1.5, s, dtype=torch.float64)
    return torch.randn(n, r, s, generator=rng, dtype=torch.float64) * scales


@pytest.mark.parametrize("size", SIZES)
def test_it_solves_as_a_fresh_factorisation_whatever_was_done(size: int) -> None:
    """Rows of several numbers, with and without a solution between them, fading and a new M."""
    rng = torch.Generator().manual_seed(size)
    M = 0.1 * torch.eye(size, dtype=torch.float64).repeat(3, 1, 1)
    information = BatchInformation(M)
    for step in range(3 * MOST_ROOTS):
        rows = random_rows(3, 1 + step % 3, size, rng)
        information.add(rows)
        M = M + rows.mT @ rows
        if step % 5 == 4:
            continue  # these rows wait for the next ones
        if step % 7 == 6:
            information.scale(0.9)
            M = 0.9 * M
        if step % 20 == 19:
            M = M + torch.eye(size, dtype=torch.float64)
            information.replace(M)
        columns = torch.randn(3, size, 2, generator=rng, dtype=torch.float64)
        assert gap(information.solve(columns), torch.linalg.solve(M, columns)) < 1e-8
        if step % 6 == 0:
            inverse = torch.linalg.inv(M)
            assert gap(information.covariance(), inverse) < 1e-8
            root = information.upper_root()
            assert gap(root @ root.mT, inverse) < 1e-8
            assert torch.equal(root, root.triu())
            assert gap(information.matrix(), M) < 1e-8
    assert information.size == size


def test_steps_of_one_kind_are_recorded_and_stay_right_where_m_is_replaced() -> None:
    size, rng = SMALL + 1, torch.Generator().manual_seed(0)
    M = 0.1 * torch.eye(size, dtype=torch.float64).repeat(3, 1, 1)
    information = BatchInformation(M)
    for change in ("none", "scale", "replace"):
        if change == "scale":
            information.scale(0.5)
            M = 0.5 * M
        elif change == "replace":
            M = M + torch.eye(size, dtype=torch.float64)
            information.replace(M)
            information.covariance()
        for _ in range(2 * MOST_ROOTS):
            rows = random_rows(3, 2, size, rng)
            information.add(rows)
            M = M + rows.mT @ rows
            columns = torch.randn(3, size, 2, generator=rng, dtype=torch.float64)
            assert gap(information.solve(columns), torch.linalg.solve(M, columns)) < 1e-8
        recording = information._solve_with_rows._recording
        assert recording is not None, change
        assert recording.can_be_repeated, change


@pytest.mark.parametrize("size", SIZES)
def test_a_trial_with_an_indefinite_matrix_has_no_solution_and_the_others_keep_theirs(
    size: int,
) -> None:
    M = torch.eye(size, dtype=torch.float64).repeat(2, 1, 1)
    M[0, 0, 0] = -1.0
    information = BatchInformation(M)
    columns = torch.ones(2, size, 1, dtype=torch.float64)
    for _ in range(2):
        solved = information.solve(columns)
        assert solved[0].isnan().all()
        assert solved[1].isfinite().all()
        information.add(torch.ones(2, 1, size, dtype=torch.float64))


@pytest.mark.parametrize("learner", ["adam_window", "ekf"])
def test_along_a_trial_it_is_the_sum_over_all_samples(learner: str) -> None:
    """At 1e-8, with a q of 386, of which M fixes far fewer directions than there are."""
    spec = trial(
        "cartpole",
        "d_optimal",
        env={"horizon": 60},
        learner={"name": learner, "noise_variance": 0.01}
        if learner == "ekf"
        else {"name": learner},
    )
    batch = Lockstep([spec, spec.with_seed(5)])
    assert batch.held is not None
    assert batch.information is not None
    q, noise = batch.theta.shape[1], batch.held.noise_variance
    M = batch.held.regularization * torch.eye(q, dtype=torch.float64).repeat(2, 1, 1)
    with torch.no_grad():
        for t in range(60):
            if learner == "ekf":  # which takes the rows before it learns
                before = batch.theta.clone()
            batch.step(t)
            theta = before if learner == "ekf" else batch.theta
            J = batch.learned.jacobian(theta, batch.sampled(slice(t, t + 1)))[:, 0] * noise**-0.5
            M = M + J.mT @ J
            if t % 15 == 14:
                columns = J.mT
                solved = batch.information.solve(columns)
                assert gap(solved, torch.linalg.solve(M, columns)) < 1e-8
