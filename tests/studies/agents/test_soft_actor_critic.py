"""The agent of Stable-Baselines3, fed by hand: what it learns, and what it leaves alone."""

from __future__ import annotations

import random

import numpy as np
import torch

from studies.agents.policies import Agent, Settings

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


def test_the_actor_is_that_of_the_library_without_noise() -> None:
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
