"""The episodic planner: plans are carried out, then searched for anew."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from dopt.errors import IncompatibleError
from dopt.kernel.run import KernelTrial
from dopt.policies import Episodic
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.trials import trial

SMALL = {"hold": 3, "stride": 2, "plans": 9, "iterations": 2, "elites": 3, "samples": 6}


def spec_of(
    env: str,
    lookahead: int,
    replan_every: int,
    learner: dict[str, Any] | None = None,
    **fields: Any,
) -> TrialSpec:
    given = SMALL | {"lookahead": lookahead, "replan_every": replan_every} | fields
    return trial(env, "episodic", 3, policy=given, model={"width": 8}, learner=learner or {})


def searches(horizon: int, replan_every: int) -> list[int]:
    """Return the steps at which plans are drawn."""
    return [t for t in range(1, horizon) if t == 1 or t % replan_every == 0]


@pytest.mark.parametrize("hold", [1, 3, 10])
@pytest.mark.parametrize("replan_every", [2, 6, 11])
def test_between_two_searches_the_inputs_are_those_of_the_plan(
    replan_every: int, hold: int
) -> None:
    spec = spec_of("arm", 11, replan_every, hold=hold)
    policy = spec.policy
    assert isinstance(policy, Episodic)
    fast = KernelTrial(spec)
    shape = (1 + policy.elites, policy.segments, 2)
    starts = [*searches(30, replan_every), 30]
    for start, following in itertools.pairwise(starts):
        fast.advance(start + 1)
        best = fast.state.policy_memory.reshape(shape)[1].copy()
        fast.advance(following)
        assert np.array_equal(fast.state.policy_memory.reshape(shape)[1], best)
        for t in range(start, following):
            assert np.array_equal(fast.record.inputs[t], best[t // hold - start // hold])
    assert len(np.unique(fast.record.inputs[1:], axis=0)) > 3


@pytest.mark.parametrize(("env", "hold"), [("pendulum", 1), ("arm", 3)])
def test_planned_anew_at_every_step_it_is_the_sampling_planner(env: str, hold: int) -> None:
    fields = SMALL | {"lookahead": 7, "hold": hold}
    every = run_trial(spec_of(env, 7, 1, hold=hold))
    plain = run_trial(trial(env, "icem", 3, policy=fields, model={"width": 8}))
    assert relative_gap(every.inputs, plain.inputs) < 1e-9


def test_a_plan_cannot_be_carried_out_past_its_end() -> None:
    with pytest.raises(
        IncompatibleError,
        match=r"policy.replan_every is 8 steps, but the plans have 7: make it smaller, or",
    ):
        spec_of("pendulum", 7, 8)
