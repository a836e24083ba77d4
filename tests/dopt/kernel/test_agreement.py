"""The compiled kernel against the torch path, where both run a trial."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from dopt.errors import IncompatibleError, SpecificationError
from dopt.kernel.run import KernelTrial
from dopt.policies import POLICIES
from dopt.policies.base import OpenLoop
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.compatibility import REFERENCE_POLICIES
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.dopt.kernel.steps import run
from tests.dopt.kernel.twin import relative_gap, transplant
from tests.dopt.trials import LEARNERS, PAIRS, trial

WINDOW = {"name": "adam_window", "window": 4}
"""Shorter than the trials, so that the kernel's ring of samples goes round twice."""
NEWEST = {"name": "adam"}
LOSS = 1e-5
"""The kernel judges a model in single precision, down to a floor; what it decides by is double."""


def learners_of(env: str, policy: str) -> list[dict[str, Any]]:
    """Return the learners to run a pair with.

    Inputs that are drawn before a trial depend neither on the learner nor on the model, and a
    learner takes every system of the same model in the same way.
    """
    if policy in LEARNERS:
        return [{}]
    if issubclass(POLICIES[policy], OpenLoop) and policy != "random":
        return [WINDOW] if env in PAPER else []
    return [NEWEST, WINDOW] if env in PAPER else [WINDOW]


def runs_on_both(env: str, policy: str) -> bool:
    """Return whether the torch path plans by a policy, and the model reads no inputs."""
    planned = POLICIES[policy] in REFERENCE_POLICIES or issubclass(POLICIES[policy], OpenLoop)
    return planned and not SYSTEMS[env].reads_inputs


PAPER = ("pendulum", "cartpole", "arm", "quadrotor")
CASES = [
    pytest.param(env, policy, learner, id=f"{env}-{policy}-{learner.get('name', 'usual')}")
    for env, policy in PAIRS
    if runs_on_both(env, policy)
    for learner in learners_of(env, policy)
]


def check_agreement(spec: TrialSpec) -> tuple[TrialResult, TrialResult]:
    """Run on both paths; states and inputs have to agree to 1e-8."""
    fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
    assert np.isfinite(plain.loss).all()
    assert relative_gap(fast.inputs, plain.inputs) < 1e-8
    assert relative_gap(fast.states, plain.states) < 1e-8
    # Least squares of the reference squares the condition, which shows once the loss is tiny.
    rounding = 1e-8 * plain.loss.max()
    assert fast.loss == pytest.approx(plain.loss, rel=LOSS, abs=rounding)
    assert fast.reachable_loss == pytest.approx(plain.reachable_loss, rel=LOSS, abs=rounding)
    assert fast.diverged_at is None
    assert plain.diverged_at is None
    return fast, plain


@pytest.mark.parametrize(("env", "policy", "learner"), CASES)
def test_both_paths_run_the_same_trial(env: str, policy: str, learner: dict[str, Any]) -> None:
    horizon = 6 if learner == NEWEST else 9  # no window to fill
    spec = trial(env, policy, 3, env={"horizon": horizon}, learner=learner)
    fast, plain = check_agreement(spec)
    if policy not in LEARNERS:  # least squares and a process are solved for, at a large condition
        assert relative_gap(fast.parameters, plain.parameters) < 1e-8


@pytest.mark.parametrize("policy", ["d_optimal", "uniform"])
@pytest.mark.parametrize("model", [{"width": 5, "depth": 1}, {"width": 7, "depth": 3}])
def test_networks_of_any_shape_agree(policy: str, model: dict[str, int]) -> None:
    check_agreement(trial("arm", policy, 4, env={"horizon": 12}, model=model))


@pytest.mark.parametrize("model", [{"width": 9, "depth": 3}, {"width": 20, "depth": 1}])
@pytest.mark.parametrize("form", ["primal", "dual", "sketch"])
@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_every_form_of_the_information_matrix_agrees(
    env: str, form: str, model: dict[str, int]
) -> None:
    policy = {"form": form, "sketch_size": 48}
    check_agreement(trial(env, "d_optimal", 2, env={"horizon": 14}, policy=policy, model=model))


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
def test_d_optimal_inputs_of_the_oracle_model_at_another_ridge(env: str) -> None:
    policy = {"name": "d_optimal", "regularization": 0.1}
    mapping: dict[str, Any] = trial(env, "oracle", 5, env={"horizon": 12}).to_mapping()
    check_agreement(TrialSpec.from_mapping(mapping | {"policy": policy}))


@pytest.mark.parametrize("policy", ["d_optimal", "uniform"])
@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
def test_late_in_a_trial_equal_states_give_equal_steps(env: str, policy: str) -> None:
    late = 150
    fast = KernelTrial(trial(env, policy, 6, env={"horizon": late + 1}))
    plain = transplant(fast, run(fast, late))
    fast.advance(late + 1)
    with torch.no_grad():
        plain.step(late)
    gamma = fast.spec.system.gamma
    assert plain.inputs[0, late].numpy() == pytest.approx(
        fast.record.inputs[late], abs=1e-8 * gamma
    )
    assert relative_gap(fast.record.states[late + 1], plain.states[0, late + 1].numpy()) < 1e-8
    assert relative_gap(fast.state.theta, plain.theta[0].numpy()) < 1e-8
    assert fast.record.loss[late] == pytest.approx(plain.columns["loss"][0, late], rel=LOSS)


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm", "quadrotor"])
def test_without_noise_the_path_is_that_of_the_simulator(env: str) -> None:
    from dopt.evaluation import simulate

    spec = trial(env, "random", env={"noise": 0.0})
    result = run_trial(spec)
    path = simulate(spec.system, result.inputs[:, None])[:, 0]
    assert result.states == pytest.approx(path, rel=1e-11, abs=1e-12)


def test_times_are_measured_and_add_up_to_less_than_the_whole() -> None:
    result = run_trial(trial("arm", "d_optimal"))
    for column in (result.plan_us, result.learn_us, result.evaluate_us):
        assert np.all(column[1:] > 0.0)
        assert column.sum() < 1e6 * result.wall_seconds


def test_the_kernel_does_not_pretend_to_run_what_it_lacks() -> None:
    mapping = trial("pendulum", "random").to_mapping()
    own = {"_target_": "tests.dopt.custom_networks.Stack"}
    with pytest.raises(SpecificationError, match="path is 'kernel', but model 'Stack'"):
        TrialSpec.from_mapping(mapping | {"model": own, "path": "kernel"})


@pytest.mark.parametrize(
    ("what", "sections"),
    [
        ("policy 'exact'", {"policy": {"name": "exact"}}),
        ("model 'affine'", {"model": {"name": "affine"}}),
        ("model 'ensemble'", {"model": {"name": "ensemble"}, "learner": {"name": "gauss_newton"}}),
        ("learner 'ekf'", {"learner": {"name": "ekf"}}),
        ("policy.information 'fresh'", {"policy": {"name": "d_optimal", "information": "fresh"}}),
        ("limits", {"limits": {"bounds": {"φ": [-1.0, 1.0]}}}),
        (
            "states that are measured with noise",
            {"env": {"name": "pendulum", "measured_states": [0], "measurement_noise": [0.1]}},
        ),
    ],
)
def test_torch_refuses_what_the_kernel_runs_alone(what: str, sections: dict[str, Any]) -> None:
    """The sentence names the executor that runs it."""
    spec = TrialSpec.from_mapping(trial("pendulum", "d_optimal").to_mapping() | sections)
    with pytest.raises(IncompatibleError, match=f"^{what} .* executor=local"):
        run_trial(spec, "reference")
