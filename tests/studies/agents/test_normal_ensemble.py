"""The ensemble of MAX: its divergence against its limits and an integral, and what it learns."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from studies.agents.policies import NormalEnsemble, jensen_renyi_divergence

SIZES = st.tuples(st.integers(2, 6), st.integers(1, 4), st.integers(1, 3))


def drawn(shape: tuple[int, ...], seed: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return spread * rng.normal(size=shape), rng.uniform(0.1, 2.0, size=shape)


@given(SIZES, st.integers(0, 99), st.floats(0.0, 30.0))
def test_the_divergence_is_at_most_the_logarithm_of_their_number(
    shape: tuple[int, int, int], seed: int, spread: float
) -> None:
    mean, variance = drawn(shape, seed, spread)
    same = np.broadcast_to(variance[:1], shape)
    found = jensen_renyi_divergence(mean, same)
    assert found.shape == shape[1:2]
    assert np.all(found >= -1e-12)
    assert np.all(found <= math.log(shape[0]) + 1e-12)


def test_distributions_that_are_the_same_do_not_diverge() -> None:
    mean, variance = drawn((1, 3, 2), 0, 1.0)
    repeated = (np.repeat(part, 5, axis=0) for part in (mean, variance))
    np.testing.assert_allclose(jensen_renyi_divergence(*repeated), 0.0, atol=1e-12)


def test_distributions_far_apart_diverge_by_the_logarithm_of_their_number() -> None:
    mean = np.arange(4.0)[:, None, None] * 1e6
    found = jensen_renyi_divergence(mean, np.ones_like(mean))
    np.testing.assert_allclose(found, math.log(4))


def test_the_divergence_is_that_of_an_integral() -> None:
    mean, variance = drawn((3, 1, 1), 2, 1.0)
    y = np.linspace(-20.0, 20.0, 200_001)
    densities = [
        np.exp(-0.5 * (y - m) ** 2 / v) / math.sqrt(2 * math.pi * v)
        for m, v in zip(mean.ravel(), variance.ravel(), strict=True)
    ]
    entropies = [-math.log(np.trapezoid(density**2, y)) for density in densities]
    mixture = -math.log(np.trapezoid(np.mean(densities, axis=0) ** 2, y))
    found = jensen_renyi_divergence(mean, variance)
    assert found[0] == pytest.approx(mixture - np.mean(entropies), abs=1e-9)


@pytest.fixture(scope="module")
def learned() -> NormalEnsemble:
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.0, 1.0, (400, 1))
    y = 50.0 + 10.0 * np.sin(3.0 * x) + 2.0 * rng.standard_normal((400, 1))
    ensemble = NormalEnsemble((5, 1, 32, 1), 3e-3, rng)
    ensemble.fit(x, y, 1500, 64)
    return ensemble


def test_mean_and_variance_are_learned(learned: NormalEnsemble) -> None:
    x = np.linspace(-0.9, 0.9, 50)[:, None]
    mean, variance = learned.predict(x)
    assert mean.shape == variance.shape == (5, 50, 1)
    assert np.sqrt(np.mean((mean.mean(axis=0) - 50.0 - 10.0 * np.sin(3.0 * x)) ** 2)) < 1.0
    assert 1.4 < np.sqrt(np.median(variance)) < 2.6


def test_the_networks_disagree_where_there_are_no_samples(learned: NormalEnsemble) -> None:
    inside, outside = np.linspace(-0.8, 0.8, 20)[:, None], np.linspace(3.0, 5.0, 20)[:, None]
    near, far = (jensen_renyi_divergence(*learned.predict(x)).mean() for x in (inside, outside))
    assert far > 5 * near


def test_the_generator_decides_about_all() -> None:
    x, y = np.ones((10, 2)), np.arange(10.0)[:, None]
    found = []
    for _ in range(2):
        ensemble = NormalEnsemble((3, 2, 8, 1), 1e-2, np.random.default_rng(4))
        ensemble.fit(x, y, 20, 4)
        found.append(ensemble.predict(x))
    np.testing.assert_array_equal(found[0], found[1])


def test_targets_that_do_not_vary_are_no_error() -> None:
    ensemble = NormalEnsemble((2, 1, 8, 1), 1e-3, np.random.default_rng(0))
    ensemble.fit(np.zeros((5, 1)), np.full((5, 1), 3.0), 5, 4)
    mean, variance = ensemble.predict(np.zeros((2, 1)))
    assert np.isfinite(mean).all()
    assert np.all(variance > 0)
