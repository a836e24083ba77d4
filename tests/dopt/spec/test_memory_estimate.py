"""The memory of a trial, estimated from its sizes, is that of the arrays which dominate it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from dopt.errors import SpecificationError
from dopt.kernel.state_from_spec import empty_record, initial_state
from dopt.randomness import draw
from dopt.spec.config import LARGEST_HORIZON
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import PAIRS, covering, trial


def size(item: Any) -> int:
    """Return the bytes of all arrays in nested tuples."""
    if isinstance(item, np.ndarray):
        return item.nbytes
    return sum(map(size, item)) if isinstance(item, tuple) else 0


def held(spec: TrialSpec) -> int:
    """Return the bytes of what a trial is made of in the kernel, its evaluation aside."""
    draws = draw(spec)
    arrays = (draws.noise, draws.inputs, draws.components, draws.ties)
    record = empty_record(spec.system)
    return size(arrays) + size(record) + size(initial_state(spec, draws.weights, record))


@pytest.mark.parametrize(("env", "policy"), covering(PAIRS))
def test_a_usual_trial_needs_little(env: str, policy: str) -> None:
    assert trial(env, policy, env={"horizon": 500}).config.memory < 2**26


@pytest.mark.parametrize(
    ("changes", "setting"),
    [
        ({"policy": {"form": "primal"}, "model": {"width": 40}}, "model.width"),
        ({"policy": {"form": "dual"}, "env": {"horizon": 1500}}, "env.horizon"),
        ({"policy": {"form": "sketch", "sketch_size": 1500}}, "policy.sketch_size"),
        ({"env": {"grid_points": (500, 400, 2)}}, "env.grid_points"),
    ],
)
def test_what_is_large_is_estimated_and_named(changes: dict[str, Any], setting: str) -> None:
    spec = trial("cartpole", "d_optimal", **changes)
    assert spec.config.largest_setting == setting
    if setting != "env.grid_points":  # whose arrays the kernel makes
        assert held(spec) <= 1.1 * spec.config.memory
        assert spec.config.memory <= 4 * held(spec)


@pytest.mark.parametrize(
    ("policy", "learner"),
    [("lookahead", "adam"), ("exact", "ekf"), ("d_optimal", "gauss_newton")],
)
def test_a_wide_network_is_estimated(policy: str, learner: str) -> None:
    wide = {"model": {"width": 48}, "learner": {"name": learner}}
    spec = trial("cartpole", policy, env={"horizon": 300}, **wide)
    assert held(spec) <= 1.5 * spec.config.memory
    assert spec.config.memory <= 8 * held(spec)


@pytest.mark.parametrize(
    ("changes", "setting"),
    [
        ({"model": {"width": 1_000_000}}, "model.width"),
        ({"model": {"depth": 2**31 - 1}}, "model.width"),
        ({"env": {"grid_points": (2**31 - 1,) * 3}}, "env.grid_points"),
        ({"policy": {"form": "sketch", "sketch_size": 10**6}}, "policy.sketch_size"),
        ({"policy": {"form": "dual"}, "env": {"horizon": 10**6}}, "env.horizon"),
    ],
)
def test_what_no_machine_can_hold_is_refused_by_name(changes: dict[str, Any], setting: str) -> None:
    with pytest.raises(SpecificationError, match=rf"GiB .* because of {setting}, .* smaller\.$"):
        trial("cartpole", "d_optimal", **changes)


def test_features_are_what_makes_a_linear_model_large() -> None:
    with pytest.raises(SpecificationError, match=r"because of model\.n_features, .* smaller\.$"):
        trial(
            "pendulum",
            "d_optimal",
            model={"name": "rff", "n_features": 1_000_000},
            learner={"name": "recursive_least_squares"},
        )


@pytest.mark.parametrize("form", ["primal", "dual"])
def test_the_reference_holds_the_matrix_in_any_form(form: str) -> None:
    spec = trial("cartpole", "d_optimal", model={"width": 256}, policy={"form": form})
    q = spec.model.n_parameters(spec.system)
    there = dataclasses.replace(spec.config, path="reference")
    assert there.memory > 2 * 8 * q**2
    assert there.largest_setting == "model.width"


def test_a_horizon_has_a_bound() -> None:
    assert trial("pendulum", "random", env={"horizon": LARGEST_HORIZON}).system.horizon
    with pytest.raises(SpecificationError, match=r"env\.horizon is 10,000,001 steps, .* at most"):
        trial("pendulum", "random", env={"horizon": LARGEST_HORIZON + 1})


FRESH = {"information": "fresh"}


@pytest.mark.parametrize("width", [16, 48])
@pytest.mark.parametrize("policy", ["d_optimal", "exact"])
def test_fresh_information_is_estimated(policy: str, width: int) -> None:
    spec = trial("arm", policy, policy=FRESH, env={"horizon": 400}, model={"width": width})
    assert held(spec) <= 1.1 * spec.config.memory
    assert spec.config.memory <= 8 * held(spec)


def test_fresh_information_that_no_machine_can_hold_is_refused_by_name() -> None:
    with pytest.raises(SpecificationError, match=r"because of model\.width, .* smaller\.$"):
        trial("arm", "d_optimal", policy=FRESH, env={"horizon": 10**7}, model={"width": 200})
