"""Trials that leave the system's limit or lose their numbers end there, on both paths alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt.reference.batch import run_trials
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import PAIRS, covering, trial

COLUMNS = ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us", "states", "inputs")
POLICIES = ["random", "uniform", "d_optimal", "oracle"]
DAMPING = {"cartpole": "pivot_friction", "mass_spring": "damping"}
ABSURD = {"learning_rate": 1e300}


def leaving(policy: str, seed: int = 0) -> TrialSpec:
    """Return a trial whose state leaves a narrow limit after some steps."""
    limit = {"random": 0.3, "oracle": 0.8}.get(policy, 1.5)
    return trial("arm", policy, seed, env={"state_limit": limit, "noise": 0.2})


def check_rows(result: TrialResult) -> int:
    """Check that exactly the rows from the divergence on are NaN; return where it is."""
    end = result.diverged_at
    assert end is not None
    for name in COLUMNS:
        rows = getattr(result, name)
        assert np.isnan(rows[end:]).all(), name
        assert np.isfinite(rows[:end]).all(), name
    assert result.diverged
    assert result.n_steps == end
    assert result.final_loss is None
    assert result.best_loss == (result.loss[:end].min() if end else None)
    return end


@pytest.mark.parametrize("policy", POLICIES)
def test_a_state_beyond_the_limit_ends_a_trial(policy: str) -> None:
    spec = leaving(policy)
    fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
    end = check_rows(fast)
    assert 1 < end < 30
    assert check_rows(plain) == end
    limit = spec.system.state_limit
    assert np.abs(fast.states[:end]).max() <= limit
    free = run_trial(trial("arm", policy, env={"noise": 0.2}), "kernel")
    assert np.array_equal(free.states[:end], fast.states[:end])
    assert np.abs(free.states[end + 1]).max() > limit
    assert fast.states[:end] == pytest.approx(plain.states[:end], rel=1e-8, abs=1e-10)
    assert fast.parameters == pytest.approx(plain.parameters, rel=1e-7, abs=1e-10)


@pytest.mark.parametrize("policy", ["random", "uniform", "d_optimal"])
def test_an_absurd_learning_rate_ends_a_trial(policy: str) -> None:
    spec = trial("pendulum", policy, learner=ABSURD)
    end = check_rows(run_trial(spec, "kernel"))
    assert check_rows(run_trial(spec, "reference")) == end


@pytest.mark.parametrize("rate", [1e3, 1e8, 1e30, 1e100, 1e154, 1e200])
@pytest.mark.parametrize("policy", ["uniform", "d_optimal"])
def test_any_learning_rate_gives_a_result(policy: str, rate: float) -> None:
    """The trial ends, or goes on with poor numbers: it never raises."""
    for env in ("pendulum", "arm"):
        spec = trial(env, policy, env={"horizon": 8}, learner={"learning_rate": rate})
        fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
        assert fast.diverged_at == plain.diverged_at
        for result in (fast, plain):
            if result.diverged:
                check_rows(result)
            else:
                assert np.isfinite(result.loss).all()


@pytest.mark.parametrize(("env", "policy"), covering(PAIRS))
def test_a_step_too_long_for_the_system_ends_a_trial(env: str, policy: str) -> None:
    fields: dict[str, Any] = {"dt": 40.0, "state_limit": 50.0}
    if policy == "periodic":
        fields[DAMPING.get(env, "friction")] = 0.0
    result = run_trial(trial(env, policy, env=fields), "kernel")
    check_rows(result)


@pytest.mark.parametrize("policy", POLICIES)
def test_a_trial_that_diverges_takes_no_other_of_its_batch_along(policy: str) -> None:
    together = run_trials([leaving(policy, seed) for seed in range(4)])
    assert len({result.diverged_at for result in together}) > 1
    for seed, many in enumerate(together[:2]):
        one = run_trial(leaving(policy, seed), "kernel")
        assert one.diverged_at == many.diverged_at
        end = check_rows(many)
        assert many.states[:end] == pytest.approx(one.states[:end], rel=1e-8, abs=1e-10)


def test_a_state_beyond_the_limit_from_the_start_leaves_no_row() -> None:
    env = {"state_limit": 0.5, "initial_state": [1.0, 0.0]}
    for path in ("kernel", "reference"):
        result = run_trial(trial("pendulum", "d_optimal", env=env), path)  # type: ignore[arg-type]
        assert check_rows(result) == 0
        assert result.best_loss is None


def test_the_properties_of_a_whole_trial() -> None:
    result = run_trial(trial("pendulum", "random"))
    assert not result.diverged
    assert result.diverged_at is None
    assert result.n_steps == 30
    assert result.final_loss == result.loss[-1]
    assert result.best_loss == result.loss.min()
    assert result.states.shape == (31, 2)
    assert result.inputs.shape == (30, 1)
    assert len(result.parameters) == 64 + 272 + 17
    assert result.wall_seconds > 0.0
    assert result.cpu_seconds >= 0.0
