"""The agent of Stable-Baselines3 and the ensemble of MAX, fed by hand: what they learn."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from studies.agents.policies import Agent, NormalEnsemble, Settings, jensen_renyi_divergence

SETTINGS = Settings(
    units=32, learning_rate=3e-3, batch_size=64, gamma=0.0, ent_coef=1e-3, buffer_size=500
)


def agent(seed: int = 0, n_actors: int = 1) -> Agent:
    return Agent(2, 1, SETTINGS, np.random.default_rng(seed), n_actors)


def fed(one: Agent, steps: int, n_actors: int = 1) -> Agent:
    """Give it transitions whose best action is half the first observed number."""
    rng = np.random.default_rng(1)
    for _ in range(steps):
        observed = rng.uniform(-1.0, 1.0, (n_actors, 2))
        actions = rng.uniform(-1.0, 1.0, (n_actors, 1))
        rewards = -((actions - 0.5 * observed[:, :1]) ** 2)[:, 0]
        one.remember(observed, actions, rewards, observed)
    return one


def test_it_learns_the_best_action() -> None:
    learned = fed(agent(n_actors=2), 250, n_actors=2)
    observed = np.linspace(-0.9, 0.9, 19)[:, None] * [1.0, -1.0]
    before = learned.actor()
    learned.learn(600)
    errors = [
        np.abs(actor(observed) - 0.5 * observed[:, :1]).mean()
        for actor in (before, learned.actor())
    ]
    assert errors[1] < 0.08 < errors[0]


def test_the_actor_equals_the_library_without_noise() -> None:
    one = fed(agent(), 80)
    one.learn(20)
    observed = np.random.default_rng(2).normal(size=(7, 2))
    expected, _ = one._sac.predict(observed.astype(np.float32), deterministic=True)
    np.testing.assert_allclose(one.actor()(observed), expected, atol=1e-5)
    np.testing.assert_allclose(one.actor()(observed[0]), expected[0], atol=1e-5)


def test_an_actor_does_not_change_afterwards() -> None:
    one = fed(agent(), 80)
    kept = one.actor()
    observed = np.ones((1, 2))
    before = kept(observed)
    one.learn(20)
    np.testing.assert_array_equal(kept(observed), before)
    assert one.actor()(observed) != before


def test_global_generators_go_on_as_if_it_were_not_there() -> None:
    def draws() -> tuple[float, ...]:
        numpy_draw = np.random.random()  # noqa: NPY002  # the generator that may not be touched
        return random.random(), numpy_draw, float(torch.rand(1))

    def begin() -> None:
        random.seed(3)
        np.random.seed(3)  # noqa: NPY002
        torch.manual_seed(3)

    begin()
    expected = draws()
    begin()
    one = fed(agent(), 80)
    one.act(np.zeros((1, 2)))
    one.learn(3)
    assert draws() == expected


def test_two_agents_do_not_disturb_each_other() -> None:
    alone, first, second = agent(), agent(), agent(5)
    for one in (alone, first, second):
        fed(one, 80)
    expected = []
    for _ in range(3):
        alone.learn(2)
        expected.append(alone.act(np.zeros((1, 2))))
    found = []
    for _ in range(3):
        first.learn(2)
        second.learn(1)
        found.append(first.act(np.zeros((1, 2))))
        second.act(np.zeros((1, 2)))
    np.testing.assert_array_equal(found, expected)


def test_what_is_forgotten_is_not_learned_from() -> None:
    one = fed(agent(), 80)
    one.forget()
    observed = np.zeros((1, 2))
    one.remember(observed, np.zeros((1, 1)), np.array([7.0]), observed)
    batch = one._buffer.sample(20)
    assert set(batch.rewards.ravel().tolist()) == {7.0}


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


def test_the_divergence_equals_an_integral() -> None:
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
