"""The information matrix over very long trials and at the edge of float64."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.kernel.linear_algebra import dense, rank_update, restore
from dopt.kernel.run import KernelTrial
from dopt.kernel.structs import Covariance
from tests.dopt.kernel.calls import interpreted
from tests.dopt.kernel.steps import run
from tests.dopt.kernel.test_information import jacobians
from tests.dopt.trials import trial

STEPS = 10_000
REGULARIZATION = 1e-7


def test_ten_thousand_steps_at_a_tiny_regularization_drift_little() -> None:
    spec = trial(
        "cartpole",
        "d_optimal",
        env={"horizon": STEPS},
        policy={"regularization": REGULARIZATION, "form": "primal"},
        learner={"name": "adam"},
    )
    fast = KernelTrial(spec)
    q = len(fast.state.theta)
    M = REGULARIZATION * np.eye(q)
    for start in range(0, STEPS, 1_000):
        parameters = run(fast, 1_000)
        J = jacobians(spec, parameters, fast.record.states[start : start + 1_000])
        rows = J.reshape(-1, q)
        M += rows.T @ rows
        carried = dense(fast.state.covariance)
        assert np.array_equal(carried, carried.T)
        assert np.linalg.eigvalsh(carried)[0] > 0.0
        probes = jacobians(spec, np.repeat(parameters[-1:], 36, axis=0), spec.system.grid())[:, 0]
        gain = np.log1p(np.einsum("ni,ij,nj->n", probes, carried, probes))
        fresh = np.log1p(np.einsum("ni,in->n", probes, np.linalg.solve(M, probes.T)))
        assert gain == pytest.approx(fresh, rel=1e-6)


def covariance(matrix: np.ndarray) -> Covariance:
    q = len(matrix)
    return Covariance(np.triu(matrix), np.zeros((4, q)), np.zeros(1, dtype=np.int64))


def test_a_negative_variance_is_mended() -> None:
    rng = np.random.default_rng(0)
    axes, _ = np.linalg.qr(rng.standard_normal((6, 6)))
    broken = axes @ np.diag([2.0, 1.0, 0.5, 0.1, 1e-3, -1e-6]) @ axes.T
    carried = covariance(broken)
    interpreted(rank_update)(carried, axes[:, 5:].T.copy(), np.zeros(1), np.zeros((1, 6)))
    assert np.linalg.eigvalsh(dense(carried))[0] >= -1e-15
    assert np.linalg.norm(dense(carried) - broken, 2) < 2e-6


def test_restoring_keeps_what_is_definite() -> None:
    rng = np.random.default_rng(1)
    A = rng.standard_normal((7, 7))
    carried = covariance(A @ A.T)
    carried.pending[0] = 1e-2 * rng.standard_normal(7)
    carried.n_pending[0] = 1
    before = dense(carried)
    interpreted(restore)(carried)
    assert carried.n_pending[0] == 0
    assert dense(carried) == pytest.approx(before, rel=1e-12, abs=1e-12)
