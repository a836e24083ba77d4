"""The memory of a trial, reckoned from its sizes, is that of the arrays which it makes."""

from __future__ import annotations

import dataclasses
import tracemalloc
from typing import Any

import numpy as np
import pytest

from dopt.control.episode import run_episode
from dopt.control.free_run import free_run_error
from dopt.control.prediction import forecast_by_equations
from dopt.errors import SpecificationError
from dopt.kernel.state_from_spec import empty_record, initial_state
from dopt.policies import DOptimal
from dopt.randomness import draw
from dopt.spec.config import LARGEST_HORIZON
from dopt.spec.memory_estimate import memory_by_setting
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import PAIRS, trial


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


@pytest.mark.parametrize(("env", "policy"), PAIRS)
def test_a_usual_trial_needs_little(env: str, policy: str) -> None:
    spec = trial(env, policy, env={"horizon": 500})
    assert held(spec) <= spec.config.memory < 2**26


@pytest.mark.parametrize(
    ("changes", "setting"),
    [
        ({"policy": {"form": "primal"}, "model": {"width": 40}}, "model.width"),
        ({"policy": {"form": "dual"}, "env": {"horizon": 1500}}, "env.horizon"),
        ({"policy": {"form": "sketch", "sketch_size": 1500}}, "policy.sketch_size"),
        ({"learner": {"window": 100_000}}, "learner.window"),
        ({"env": {"grid_points": (500, 400, 2)}}, "env.grid_points"),
    ],
)
def test_what_is_large_is_reckoned_and_named(changes: dict[str, Any], setting: str) -> None:
    spec = trial("cartpole", "d_optimal", **changes)
    assert spec.config.largest_setting == setting
    if setting not in ("env.grid_points", "learner.window"):  # whose arrays the kernel makes
        assert held(spec) <= spec.config.memory <= 4 * held(spec)


@pytest.mark.parametrize(
    ("changes", "setting"),
    [
        ({"model": {"width": 1_000_000}}, "model.width"),
        ({"model": {"depth": 2**31 - 1}}, "model.width"),
        ({"env": {"grid_points": (100_000, 100_000, 100)}}, "env.grid_points"),
        ({"env": {"grid_points": (2**31 - 1,) * 3}}, "env.grid_points"),
        ({"learner": {"window": 2**31 - 1}}, "learner.window"),
        ({"policy": {"form": "sketch", "sketch_size": 10**6}}, "policy.sketch_size"),
        ({"policy": {"form": "dual"}, "env": {"horizon": 10**6}}, "env.horizon"),
    ],
)
def test_what_no_machine_can_hold_is_refused_by_name(changes: dict[str, Any], setting: str) -> None:
    with pytest.raises(SpecificationError, match=rf"GiB .* because of {setting}, .* smaller\.$"):
        trial("cartpole", "d_optimal", **changes)


@pytest.mark.parametrize(
    ("policy", "field"),
    [
        ("sac", "units"),
        *(("max_agent", name) for name in ("units", "ensemble", "actors", "batch")),
    ],
)
def test_an_agent_that_no_machine_can_hold_is_refused_by_name(policy: str, field: str) -> None:
    message = rf"GiB .* because of policy\.{field}, .* smaller\.$"
    with pytest.raises(SpecificationError, match=message):
        trial("cartpole", policy, policy={field: 10**9})


@pytest.mark.parametrize(
    ("policy", "changes", "setting"),
    [
        ("max", {"policy": {"ensemble": 2**31 - 1}}, "policy.ensemble"),
        ("max", {"policy": {"candidates": 2**31 - 1}}, "policy.candidates"),
        ("gaussian_process", {"env": {"horizon": 10**6}}, "env.horizon"),
        ("gradient", {"model": {"width": 1_000}}, "model.width"),
        ("gradient", {"policy": {"candidates": 2**31 - 1}}, "policy.candidates"),
    ],
)
def test_what_the_reference_cannot_hold_is_refused_by_name(
    policy: str, changes: dict[str, Any], setting: str
) -> None:
    with pytest.raises(SpecificationError, match=rf"GiB .* because of {setting}, .* smaller\.$"):
        trial("cartpole", policy, **changes)


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
    assert there.memory > 3 * 8 * q**2
    assert there.largest_setting == "model.width"


def test_the_sketch_of_the_reference_is_a_matrix() -> None:
    spec = trial("cartpole", "d_optimal", model={"width": 256}, policy={"form": "sketch"})
    q = spec.model.n_parameters(spec.system)
    there = dataclasses.replace(spec.config, path="reference")
    assert there.memory - spec.config.memory == pytest.approx(8 * 256 * q, rel=0.05)


TASK = {"name": "control", "checkpoints": []}


def with_task(env: str, **fields: Any) -> TrialSpec:
    mapping = trial(env, "random").to_mapping()
    return TrialSpec.from_mapping(mapping | {"task": TASK | fields})


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "quadrotor"])
@pytest.mark.parametrize(
    ("sizes", "setting"),
    [
        ({"samples": 5_000}, "task.samples"),
        ({"samples": 500, "lookahead": 600}, "task.lookahead"),
        ({"samples": 100, "hold": 200}, "task.hold"),
    ],
)
def test_the_planner_of_a_task_is_reckoned(env: str, sizes: dict[str, Any], setting: str) -> None:
    spec = with_task(env, steps=1, settle_steps=1, iterations=1, **sizes)
    assert spec.config.largest_setting == setting
    assert spec.task is not None
    system, task, rng = spec.system, spec.task, np.random.default_rng(0)
    truth = forecast_by_equations(system)
    tracemalloc.start()
    run_episode(system, task, truth, truth, np.zeros((1, system.n_states)), rng)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= spec.config.memory <= 2 * peak


@pytest.mark.parametrize("env", ["pendulum", "quadrotor"])
def test_the_free_run_of_a_task_is_reckoned(env: str) -> None:
    spec = with_task(env, free_run_steps=500)
    assert spec.config.largest_setting == "task.free_run_steps"
    truth = forecast_by_equations(spec.system)
    tracemalloc.start()
    free_run_error(spec.system, truth, 500)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= spec.config.memory <= 2 * peak


@pytest.mark.parametrize("field", ["samples", "lookahead", "hold", "free_run_steps"])
def test_a_task_that_no_machine_can_hold_is_refused_by_name(field: str) -> None:
    with pytest.raises(
        SpecificationError, match=rf"GiB .* because of task\.{field}, .* smaller\.$"
    ):
        with_task("quadrotor", **{field: 2**31 - 1})


def test_a_horizon_has_a_bound() -> None:
    assert trial("pendulum", "random", env={"horizon": LARGEST_HORIZON}).system.horizon
    with pytest.raises(SpecificationError, match=r"env\.horizon is 10,000,001 steps, .* at most"):
        trial("pendulum", "random", env={"horizon": LARGEST_HORIZON + 1})


FRESH = {"information": "fresh"}


@pytest.mark.parametrize("width", [5, 16, 48])
@pytest.mark.parametrize("policy", ["d_optimal", "exact"])
def test_fresh_information_is_reckoned(policy: str, width: int) -> None:
    fields = {"env": {"horizon": 400}, "model": {"width": width}}
    fresh = trial("arm", policy, policy=FRESH, **fields)
    plain = trial("arm", policy, policy={}, **fields)
    T, q = 400, fresh.model.n_parameters(fresh.system)
    p, r = len(fresh.system.features), fresh.system.n_learned
    assert held(fresh) <= fresh.config.memory
    pairs = 2 * T * (max(width, p) + 1) ** 2
    assert fresh.config.memory - plain.config.memory >= 8 * (2 * T * p + pairs)
    there = dataclasses.replace(fresh.config, path="reference")
    assert there.memory >= 8 * (T * r * q + q**2)


def test_a_linear_model_needs_no_memory_for_fresh_information() -> None:
    system, learner = trial("arm", "oracle").system, trial("arm", "oracle").learner
    model = trial("arm", "oracle").model
    sizes = [
        memory_by_setting(system, DOptimal(information=information), model, learner, path)
        for information in ("accumulated", "fresh")
        for path in ("kernel", "reference")
    ]
    assert sizes[:2] == sizes[2:]


def test_fresh_information_that_no_machine_can_hold_is_refused_by_name() -> None:
    with pytest.raises(SpecificationError, match=r"because of model\.width, .* smaller\.$"):
        trial("arm", "d_optimal", policy=FRESH, env={"horizon": 10**7}, model={"width": 200})
