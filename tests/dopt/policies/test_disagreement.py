"""MAX: the disagreement of an ensemble against plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.errors import IncompatibleError, SpecificationError
from dopt.kernel.steps import SteppedTrial
from dopt.policies.held_candidates import DisagreementPlan
from dopt.run import run_trial
from tests.dopt.trials import trial


def started(env: str, steps: int, **policy: int) -> tuple[SteppedTrial, DisagreementPlan]:
    """Return a trial after some steps, and its plan."""
    fast = SteppedTrial(trial(env, "max", 3, policy=policy, env={"horizon": 12}))
    fast.advance(steps)
    assert fast._parts is not None
    assert isinstance(fast._parts._planner, DisagreementPlan)
    return fast, fast._parts._planner


@pytest.mark.parametrize("lookahead", [1, 3])
@pytest.mark.parametrize("env", ["cartpole", "quadrotor"])
def test_the_worth_is_the_variance_across_networks_where_the_input_leads(
    env: str, lookahead: int
) -> None:
    fast, plan = started(env, 4, ensemble=3, lookahead=lookahead, candidates=5)
    system, predict = fast.spec.system, fast.spec.model.predict
    members = [fast.parameters, *plan._others]
    assert fast._parts is not None
    found = plan.worth(fast._parts._view(4))
    for u, worth in zip(plan._inputs, found, strict=True):
        z, expected = fast.states[4], 0.0
        for _ in range(lookahead):
            mean = np.mean([predict(system, theta, z[None])[0] for theta in members], axis=0)
            step = np.array(system.known(tuple(z), tuple(u), system.parameters))
            step[list(system.learned_rows)] += mean
            z = z + system.dt * step
            each = [predict(system, theta, z[None])[0] for theta in members]
            expected += np.var(each, axis=0).sum()
        assert worth == pytest.approx(expected, rel=1e-9)
    fast.advance(5)
    assert np.array_equal(fast.inputs[4], plan._inputs[np.argmax(found)])
    assert np.ptp(found) > 0.0


@pytest.mark.parametrize("learner", ["adam", "adam_window"])
def test_every_network_learns_what_the_trials_own_learns(learner: str) -> None:
    """Started from the same weights they stay the same."""
    fast = SteppedTrial(trial("arm", "max", 3, learner={"name": learner}))
    plan = fast._parts._planner  # type: ignore[union-attr]
    assert isinstance(plan, DisagreementPlan)
    assert len(np.unique(np.concatenate([fast.parameters[None], plan._others]), axis=0)) == 5
    plan._others[:] = fast.parameters
    fast.advance(12)
    assert plan._others == pytest.approx(np.tile(fast.parameters, (4, 1)), rel=1e-9, abs=1e-12)


def test_one_network_is_no_ensemble() -> None:
    with pytest.raises(SpecificationError, match=r"policy\.ensemble is 1.*at least 2"):
        trial("arm", "max", policy={"ensemble": 1})


@pytest.mark.parametrize("model", ["rff", "grey_box", "ensemble"])
def test_an_ensemble_is_one_of_networks(model: str) -> None:
    learner = {"rff": "recursive_least_squares", "ensemble": "gauss_newton"}.get(model, "adam")
    with pytest.raises(IncompatibleError, match="policy 'max' goes with model 'mlp'"):
        trial("arm", "max", model={"name": model}, learner={"name": learner})


def test_a_repetition_is_the_same() -> None:
    spec = trial("quadrotor", "max", 1, env={"horizon": 12})
    assert np.array_equal(run_trial(spec).inputs, run_trial(spec).inputs)
