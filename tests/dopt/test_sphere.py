"""Quadratic problems on the sphere, directions, and the batch solver of the torch path."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dopt.errors import DoptError
from dopt.policies.search import LARGEST_REPELLED, sphere_directions
from dopt.reference.models import d_optimal_inputs, maximize_on_spheres
from dopt.sphere import maximize_on_sphere, sphere_maximizer


def value(Q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return uᵀQu - 2vᵀu of points, (..., m)."""
    return np.einsum("...i,ij,...j->...", u, Q, u) - 2.0 * u @ v


def size(Q: np.ndarray, v: np.ndarray, radius: float) -> float:
    """Return a bound of the objective's terms on the sphere."""
    return float(len(v) * (radius**2 * np.abs(Q).max() + radius * np.abs(v).max()))


def from_eigenvalues(values: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a symmetric matrix with these eigenvalues, and its axes in columns."""
    drawn = np.random.default_rng(seed).standard_normal((len(values), len(values)))
    axes = np.linalg.qr(drawn)[0]
    Q = axes @ np.diag(values) @ axes.T
    return 0.5 * (Q + Q.T), axes


def check_optimal(Q: np.ndarray, v: np.ndarray, radius: float, tie: np.ndarray) -> np.ndarray:
    """Solve, and check what is necessary and sufficient: (Q - μI) u = v with μ ≥ λ_max."""
    u = maximize_on_sphere(Q, v, radius, tie)
    assert np.linalg.norm(u) == pytest.approx(radius, rel=1e-14)
    scale = size(Q, v, radius) / radius
    multiplier = (u @ Q @ u - v @ u) / radius**2
    assert np.linalg.norm(Q @ u - multiplier * u - v) <= 1e-11 * scale
    assert radius * (multiplier - np.linalg.eigvalsh(Q)[-1]) >= -1e-11 * scale
    return u


@st.composite
def problems(
    draw: st.DrawFn, dimension: int | None = None
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Draw Q of any definiteness and rank, v along few or all axes, scales of all sizes."""
    m = dimension or draw(st.integers(1, 6))
    levels = st.sampled_from([-3.0, -1.0, 0.0, 1e-9, 1.0, 1.0 + 1e-12, 2.0]) | st.floats(-5.0, 5.0)
    values = 10.0 ** draw(st.integers(-8, 8)) * draw(arrays(float, m, elements=levels))
    Q, axes = from_eigenvalues(values, draw(st.integers(0, 99)))
    shares = st.sampled_from([0.0, 1e-14, 1e-7, 1.0]) | st.floats(-2.0, 2.0)
    v = axes @ draw(arrays(float, m, elements=shares)) * 10.0 ** draw(st.integers(-8, 8))
    tie = np.random.default_rng(draw(st.integers(0, 99))).standard_normal(m)
    return Q, v, 10.0 ** draw(st.integers(-3, 3)), tie


def in_batch(Q: np.ndarray, v: Any, radius: float, tie: Any) -> np.ndarray:
    """Return the input of the torch path's solver, (m,)."""
    given = [torch.tensor(np.asarray(array))[None] for array in (Q, v, tie)]
    found: np.ndarray = maximize_on_spheres(given[0], given[1], radius, given[2])[0].numpy()
    return found


@settings(max_examples=200)
@given(problems())
def test_both_solvers_meet_the_optimality_conditions(
    problem: tuple[np.ndarray, np.ndarray, float, np.ndarray],
) -> None:
    Q, v, radius, _ = problem
    copies = [np.copy(part) for part in problem]
    best, u = value(Q, v, check_optimal(*problem)), in_batch(*problem)
    assert np.linalg.norm(u) == pytest.approx(radius, rel=1e-13)
    assert value(Q, v, u) == pytest.approx(best, rel=0.0, abs=1e-11 * size(Q, v, radius))
    assert all(map(np.array_equal, problem, copies)), "the arguments are not changed"


@given(st.floats(-1e8, 1e8), st.floats(-1e8, 1e8), st.floats(1e-3, 1e3))
def test_one_input_goes_against_v(q: float, v: float, radius: float) -> None:
    u = maximize_on_sphere(np.array([[q]]), np.array([v]), radius, np.array([-0.3]))
    # v too small beside q to be seen is a tie.
    side = -np.sign(v) if abs(v) > 1e-140 * radius * abs(q) else -1.0
    assert u == pytest.approx([side * radius])


@pytest.mark.parametrize("share", [0.0, *(10.0**-k for k in (2, 5, 8, 12, 15, 17, 40, 149, 300))])
@pytest.mark.parametrize("m", [2, 3, 5])
def test_hard_and_nearly_hard_cases(share: float, m: int) -> None:
    """Parameter ``share`` is the part of v along the top axis; the rest is short of the sphere."""
    values = np.linspace(-1.0, 1.0, m)
    Q, axes = np.diag(values), np.eye(m)
    v = 0.1 * axes[:, 0] + share * axes[:, -1]
    u = check_optimal(Q, v, 2.0, np.ones(m))
    assert u[0] == pytest.approx(-0.1 / (values[-1] - values[0]), rel=10 * share + 1e-12)
    assert np.sign(u[-1]) == (-1.0 if share > 1e-150 else 1.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("share", [0.0, 1e-12, 1e-8, 1e-3])
def test_the_tie_chooses_the_side_in_the_hard_case(side: float, share: float) -> None:
    Q, v = np.diag([-1.0, 0.5, 2.0]), np.array([0.3, -0.2, share])
    tie = np.array([0.1, 0.0, side])
    u = check_optimal(Q, v, 1.0, tie)
    assert np.sign(u[2]) == (-1.0 if share else side)
    assert in_batch(Q, v, 1.0, tie) == pytest.approx(u, abs=1e-7)
    # The rest of v alone is too long for the sphere: the root lies beyond the pole.
    check_optimal(Q, np.array([5.0, -9.0, 0.0]), 1.0, tie)


@pytest.mark.parametrize("values", [[0, 0, 0], [1, 1, 1], [-2.5] * 3, [-1, 0.5, 2], [0, 1, 1]])
@pytest.mark.parametrize("tie", [[0.6, 0.0, 0.8], [0.0, -3.0, 0.0], [0.0, 0.0, 0.0]])
def test_both_solvers_take_the_same_direction_where_v_is_zero(
    values: list[float], tie: list[float]
) -> None:
    Q, v = np.diag(np.array(values, float)), np.zeros(3)
    u = maximize_on_sphere(Q, v, 2.0, np.array(tie))
    assert np.linalg.norm(u) == pytest.approx(2.0)
    assert in_batch(Q, v, 2.0, tie) == pytest.approx(u, abs=1e-12)


@given(arrays(float, 4, elements=st.floats(-1, 1)).filter(lambda tie: np.linalg.norm(tie) > 1e-3))
def test_the_tie_is_the_answer_where_all_inputs_are_equal(tie: np.ndarray) -> None:
    expected = 3.0 * tie / np.linalg.norm(tie)
    for Q in (np.zeros((4, 4)), np.eye(4), -2.5 * np.eye(4)):
        assert maximize_on_sphere(Q, np.zeros(4), 3.0, tie) == pytest.approx(expected, abs=1e-12)


@settings(max_examples=60)
@given(problems(), st.integers(0, 99))
def test_a_tie_decides_nothing_else(
    problem: tuple[np.ndarray, np.ndarray, float, np.ndarray], seed: int
) -> None:
    Q, v, radius, tie = problem
    other = np.random.default_rng(1000 + seed).standard_normal(len(v))
    one = value(Q, v, maximize_on_sphere(Q, v, radius, tie))
    two = value(Q, v, maximize_on_sphere(Q, v, radius, other))
    assert one == pytest.approx(two, rel=0.0, abs=1e-12 * size(Q, v, radius))


def test_only_the_symmetric_part_counts() -> None:
    Q, v = np.array([[1.0, 3.0], [-1.0, 0.5]]), np.array([0.2, -0.1])
    symmetric = maximize_on_sphere(0.5 * (Q + Q.T), v, 1.5, np.ones(2))
    assert maximize_on_sphere(Q, v, 1.5, np.ones(2)) == pytest.approx(symmetric, rel=1e-14)


@settings(max_examples=100)
@given(problems(), st.integers(-900, 900), st.integers(-900, 900))
@example((np.diag([1.0, 4.0]), np.zeros(2), 1.0, np.array([0.9, 0.1])), -700, -700)
@example((np.diag([1.0, 4.0]), np.zeros(2), 1.0, np.array([0.9, 0.1])), 900, 900)
def test_the_sizes_of_radius_and_objective_do_not_matter(
    problem: tuple[np.ndarray, np.ndarray, float, np.ndarray], power: int, radius_power: int
) -> None:
    """Powers of two are exact: γ|Q| overflows or underflows with them, γQ : v does not change."""
    Q, v, radius, tie = problem
    c = 2.0**radius_power
    large_Q, large_v = 2.0**power * Q, scaled(v, power + radius_power)
    assume(np.array_equal(scaled(large_v, -power - radius_power), v))
    assume(np.array_equal(large_Q / 2.0**power, Q))
    plain = maximize_on_sphere(Q, v, radius, tie)
    found = maximize_on_sphere(large_Q, large_v, c * radius, tie) / c
    best, bound = value(Q, v, plain), 1e-12 * size(Q, v, radius)
    assert value(Q, v, found) == pytest.approx(best, rel=0.0, abs=bound)


def scaled(v: np.ndarray, power: int) -> np.ndarray:
    """Return 2^power v, where a power of more than 1023 takes two steps."""
    with np.errstate(over="ignore", under="ignore"):
        return np.asarray(np.ldexp(v, power))


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(wrong: float) -> None:
    """The compiled solver returns no input then."""
    none = sphere_maximizer(np.diag([1.0, wrong]), np.array([0.0, 1.0]), 2.0, np.ones(2))
    assert np.isnan(none).all()
    for Q, v in ((np.diag([1.0, wrong]), np.zeros(2)), (np.eye(2), np.array([wrong, 0.0]))):
        with pytest.raises(DoptError, match="not finite"):
            maximize_on_sphere(Q, v, 1.0, np.ones(2))


@pytest.mark.parametrize("m", [1, 2, 3, 4, 7])
def test_directions_are_unit_vectors_and_always_the_same(m: int) -> None:
    for count in (1, 2, 8, 33, LARGEST_REPELLED + 1):
        found = sphere_directions(m, count)
        assert found.shape == (2 if m == 1 else count, m)
        assert np.linalg.norm(found, axis=1) == pytest.approx(1.0, rel=1e-12)
        assert np.array_equal(found, sphere_directions.__wrapped__(m, count))


@settings(max_examples=20)
@given(st.integers(1, 6), st.integers(1, 40))
def test_no_direction_comes_twice(m: int, count: int) -> None:
    found = sphere_directions(m, count)
    assert len(np.unique(found.round(9), axis=0)) == len(found)


@pytest.mark.parametrize("count", [7, 16])
def test_two_inputs_have_directions_at_equal_angles(count: int) -> None:
    found = sphere_directions(2, count)
    cos, sin = np.cos(2 * np.pi / count), np.sin(2 * np.pi / count)
    turned = found @ np.array([[cos, sin], [-sin, cos]])
    assert turned == pytest.approx(np.roll(found, -1, axis=0), abs=1e-12)


@pytest.mark.parametrize(
    ("m", "count", "best"),
    [
        (3, 4, np.arccos(-1 / 3)),
        (3, 6, np.pi / 2),
        (3, 12, np.arccos(1 / 5**0.5)),
        (4, 8, np.pi / 2),
    ],
)
def test_more_inputs_have_directions_nearly_as_far_apart_as_can_be(
    m: int, count: int, best: float
) -> None:
    """Tetrahedron, octahedron, icosahedron and 16-cell are the optimal codes of their size."""
    found = sphere_directions(m, count)
    angles = np.arccos(np.clip(found @ found.T - 2 * np.eye(count), -1, 1))
    assert angles.min() > 0.9 * best


@pytest.mark.parametrize("count", [64, 20_000])
def test_more_inputs_prefer_no_direction(count: int) -> None:
    found = sphere_directions(4, count)
    assert found.mean(axis=0) == pytest.approx(0.0, abs=0.01)
    assert np.cov(found.T, bias=True) == pytest.approx(np.eye(4) / 4, abs=0.01)


@pytest.mark.parametrize("unit", [1e-320, 1e-200, 1e200, 1e308])
@pytest.mark.parametrize("radius", [1e-200, 1.0, 1e200])
def test_both_solvers_bear_numbers_of_any_size(unit: float, radius: float) -> None:
    Q, tie = unit * np.diag([0.25, 1.0]), np.array([0.1, 0.9])
    for v in ([0.0, 0.0], [0.0, -1e-300], [0.0, -1.0]):
        for u in (maximize_on_sphere(Q, np.array(v), radius, tie), in_batch(Q, v, radius, tie)):
            assert u / radius == pytest.approx([0.0, 1.0], abs=1e-9)


@pytest.mark.parametrize("v", [-0.7, 0.0, 0.7])
@pytest.mark.parametrize("tie", [-1.0, 0.0, 1.0])
def test_one_input_takes_the_side_that_the_kernel_takes(v: float, tie: float) -> None:
    problem = torch.ones(1, 1, 1).double(), torch.tensor([[v]]).double()
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
    u = d_optimal_inputs((Q, v), 2.0, torch.ones(3, m).double())
    assert torch.allclose(u[0], torch.full((m,), -2.0 / m**0.5).double())
    assert u[1:].isnan().all()
