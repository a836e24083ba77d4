"""Common random numbers: what is shared between policies, and what no draw may move."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from dopt.randomness import _STREAMS, draw, stream
from dopt.systems import SYSTEMS
from tests.dopt.trials import KNOWN_EFFECT, MODELS, PAIRS, trial

NAMES = ("noise", "weights", "inputs", "components", "ties")
STREAMS = tuple(_STREAMS)


@pytest.mark.parametrize("env", KNOWN_EFFECT)
def test_policies_that_are_compared_share_noise_and_initial_weights(env: str) -> None:
    policies = [policy for e, policy in PAIRS if e == env]
    specs = [trial(env, policy, 11) for policy in policies if policy not in MODELS]
    first, *others = (draw(spec) for spec in specs)
    assert len(others) > 2
    for other in others:
        for name in ("noise", "weights", "components", "ties"):
            assert np.array_equal(getattr(first, name), getattr(other, name)), name
    for policy in {"oracle", *policies} & set(MODELS):  # whose models are no networks
        assert np.array_equal(first.noise, draw(trial(env, policy, 11)).noise)


@pytest.mark.parametrize("env", SYSTEMS)
def test_another_seed_moves_every_draw(env: str) -> None:
    one, two = draw(trial(env, "random", 0)), draw(trial(env, "random", 1))
    assert not np.any(one.noise == two.noise)
    assert not np.any(one.weights == two.weights)
    assert not np.any(one.inputs == two.inputs)


def test_a_longer_trial_begins_with_the_same_noise() -> None:
    short = draw(trial("arm", "d_optimal", 3))
    long = draw(trial("arm", "d_optimal", 3, env={"horizon": 70}))
    assert np.array_equal(short.noise, long.noise[:30])
    assert np.array_equal(short.weights, long.weights)


def test_a_wider_network_leaves_noise_inputs_and_components_alone() -> None:
    narrow = draw(trial("arm", "d_optimal", 3))
    wide = draw(trial("arm", "d_optimal", 3, model={"width": 32, "depth": 3}))
    assert len(wide.weights) > len(narrow.weights)
    for name in ("noise", "inputs", "components", "ties"):
        assert np.array_equal(getattr(narrow, name), getattr(wide, name)), name


def test_every_stream_is_another() -> None:
    first = {stream(5, name).integers(2**63) for name in STREAMS}
    assert len(first) == len(STREAMS)


def test_streams_are_not_correlated() -> None:
    rows = np.stack(
        [stream(seed, name).standard_normal(10_000) for seed in (0, 1) for name in STREAMS]
    )
    correlations = np.corrcoef(rows) - np.eye(len(rows))
    assert np.abs(correlations).max() < 0.05


def test_the_noise_has_variance_dt_sigma_squared() -> None:
    spec = trial("quadrotor", "random", env={"horizon": 20_000, "dt": 0.04, "noise": 0.3})
    noise = draw(spec).noise
    assert noise.var(axis=0) == pytest.approx(0.04 * 0.3**2, rel=0.05)
    assert noise.mean(axis=0) == pytest.approx(0.0, abs=5 * 0.3 * 0.2 / np.sqrt(20_000))


def test_components_are_drawn_evenly_among_the_learned_ones() -> None:
    components = draw(trial("arm", "d_optimal", env={"horizon": 10_000})).components
    assert set(components.tolist()) == {0, 1}
    assert components.mean() == pytest.approx(0.5, abs=0.03)


def test_weights_are_uniform_within_one_over_root_fan_in() -> None:
    spec = trial("arm", "d_optimal", model={"width": 64, "depth": 2})
    weights = np.split(draw(spec).weights, np.cumsum([7 * 64, 65 * 64]))
    for layer, fan_in in zip(weights, (6, 64, 64), strict=True):
        bound = 1 / np.sqrt(fan_in)
        assert 0.9 * bound < np.abs(layer).max() <= bound
    assert weights[1].std() == pytest.approx(1 / np.sqrt(3 * 64), rel=0.05)


def test_ties_are_unit_vectors_in_all_directions() -> None:
    ties = draw(trial("arm", "d_optimal", env={"horizon": 5_000})).ties
    assert np.linalg.norm(ties, axis=1) == pytest.approx(1.0)
    assert np.abs(ties.mean(axis=0)).max() < 0.05


def test_the_same_trial_draws_the_same_numbers() -> None:
    for env, policy in itertools.islice(PAIRS, 0, None, 5):
        one, two = draw(trial(env, policy, 2)), draw(trial(env, policy, 2))
        for name in NAMES:
            assert np.array_equal(getattr(one, name), getattr(two, name))
