"""The information of a batch against fresh factorisations of M."""

from __future__ import annotations

import pytest
import torch

from dopt.reference.planning import SMALL, BatchInformation

SIZES = (7, SMALL, SMALL + 1, 150)


@pytest.mark.parametrize("size", SIZES)
def test_it_solves_as_a_fresh_factorisation(size: int) -> None:
    rng = torch.Generator().manual_seed(size)
    M = 0.1 * torch.eye(size, dtype=torch.float64).repeat(3, 1, 1)
    information = BatchInformation(0.1, M[:, 0])
    scales = torch.logspace(-1.5, 1.5, size, dtype=torch.float64)
    for step in range(48):
        rows = torch.randn(3, 1 + step % 3, size, generator=rng, dtype=torch.float64) * scales
        information.add(rows)
        M = M + rows.mT @ rows
        columns = torch.randn(3, size, 2, generator=rng, dtype=torch.float64)
        expected = torch.linalg.solve(M, columns)
        gap = (information.solve(columns) - expected).abs().max() / expected.abs().max()
        assert gap < 1e-8


@pytest.mark.parametrize("size", SIZES)
def test_a_trial_without_a_factor_has_no_solution_and_the_others_keep_theirs(size: int) -> None:
    information = BatchInformation(1.0, torch.zeros(2, size, dtype=torch.float64))
    rows, columns = torch.ones(2, 1, size).double(), torch.ones(2, size, 1).double()
    rows[0] = torch.nan
    information.add(rows)
    solved = information.solve(columns)
    assert solved[0].isnan().all()
    assert solved[1].isfinite().all()
