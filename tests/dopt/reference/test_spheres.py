"""The batched solver of the reference against the one that the kernel compiles."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dopt.reference.planning import QuadraticProblem, d_optimal_inputs, maximize_on_spheres
from dopt.sphere import maximize_on_sphere
from tests.dopt.math.test_sphere import problems, size, value


@settings(max_examples=150)
@given(problems())
def test_both_solvers_find_the_same_value(
    problem: tuple[np.ndarray, np.ndarray, float, np.ndarray],
) -> None:
    Q, v, radius, tie = problem
    batch = (torch.tensor(array)[None] for array in (Q, v))
    u = maximize_on_spheres(*batch, radius, torch.tensor(tie)[None])[0].numpy()
    assert np.linalg.norm(u) == pytest.approx(radius, rel=1e-13)
    best = value(Q, v, maximize_on_sphere(Q, v, radius, tie))
    assert value(Q, v, u) == pytest.approx(best, rel=0.0, abs=1e-11 * size(Q, v, radius))


@pytest.mark.parametrize("share", [0.0, 1e-12, 1e-8, 1e-3])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_both_solvers_break_a_tie_alike(side: float, share: float) -> None:
    Q, v, tie = np.diag([-1.0, 0.5, 2.0]), np.array([0.3, -0.2, share]), np.array([0.1, 0.2, side])
    expected = maximize_on_sphere(Q, v, 1.0, tie)
    batch = [torch.tensor(array)[None] for array in (Q, v, tie)]
    found = maximize_on_spheres(batch[0], batch[1], 1.0, batch[2])
    assert found[0].numpy() == pytest.approx(expected, abs=1e-7)


FLAT = (np.zeros((3, 3)), np.eye(3), -2.5 * np.eye(3))
TIES = ([0.6, 0.0, 0.8], [0.0, -3.0, 0.0], [0.0, 0.0, 0.0])


@pytest.mark.parametrize("Q", [*FLAT, np.diag([-1.0, 0.5, 2.0]), np.diag([0.0, 1.0, 1.0])])
@pytest.mark.parametrize("tie", TIES)
def test_both_solvers_take_the_same_direction_where_v_is_zero(
    Q: np.ndarray, tie: list[float]
) -> None:
    expected = maximize_on_sphere(Q, np.zeros(3), 2.0, np.array(tie))
    batch = [torch.tensor(np.asarray(array))[None] for array in (Q, np.zeros(3), tie)]
    found = maximize_on_spheres(batch[0], batch[1], 2.0, batch[2])
    assert found[0].numpy() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("unit", [1e-320, 1e-200, 1e200, 1e308])
@pytest.mark.parametrize("radius", [1e-200, 1.0, 1e200])
@pytest.mark.parametrize("v", [[0.0, 0.0], [0.0, -1e-300], [0.0, -1.0]])
def test_both_solvers_bear_numbers_of_any_size(unit: float, radius: float, v: list[float]) -> None:
    Q, tie = unit * np.diag([0.25, 1.0]), np.array([0.1, 0.9])
    expected = maximize_on_sphere(Q, np.array(v), radius, tie)
    batch = [torch.tensor(np.asarray(array))[None] for array in (Q, v, tie)]
    found = maximize_on_spheres(batch[0], batch[1], radius, batch[2])[0].numpy()
    assert expected / radius == pytest.approx([0.0, 1.0], abs=1e-9)
    assert found / radius == pytest.approx([0.0, 1.0], abs=1e-9)


@pytest.mark.parametrize("v", [-0.7, 0.0, 0.7])
@pytest.mark.parametrize("tie", [-1.0, 0.0, 1.0])
def test_one_input_takes_the_side_that_the_kernel_takes(v: float, tie: float) -> None:
    problem = QuadraticProblem(torch.ones(1, 1, 1).double(), torch.tensor([[v]]).double())
    u = d_optimal_inputs(problem, 2.0, torch.tensor([[tie]]).double())
    assert float(u) == (2.0 if v < 0.0 or (v == 0.0 and tie > 0.0) else -2.0)


@settings(max_examples=20)
@given(st.lists(problems(2), min_size=2, max_size=5))
def test_a_batch_is_its_problems_one_by_one(
    several: list[tuple[np.ndarray, np.ndarray, float, np.ndarray]],
) -> None:
    Q, v, ties = (torch.tensor(np.stack([p[i] for p in several])) for i in (0, 1, 3))
    together = maximize_on_spheres(Q, v, 2.0, ties)
    for i in range(len(several)):
        alone = maximize_on_spheres(Q[i : i + 1], v[i : i + 1], 2.0, ties[i : i + 1])
        assert torch.allclose(together[i], alone[0], rtol=1e-12)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_a_problem_that_is_not_finite_has_no_input_and_disturbs_no_other(m: int) -> None:
    Q, v = torch.eye(m).double().repeat(3, 1, 1), torch.ones(3, m).double()
    Q[1, -1, -1], v[1, 0], v[2, 0] = torch.nan, torch.nan, torch.nan
    u = d_optimal_inputs(QuadraticProblem(Q, v), 2.0, torch.ones(3, m).double())
    assert torch.allclose(u[0], torch.full((m,), -2.0 / m**0.5).double())
    assert u[1:].isnan().all()
