from __future__ import annotations

import numpy as np
import pytest
import torch

from dopt.errors import SpecificationError
from dopt.run import rerun, run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.torch_models import model_of_one
from tests.dopt.trials import KNOWN_EFFECT


def specification(env: str = "pendulum", policy: str = "d_optimal", **model: object) -> TrialSpec:
    linear = policy == "oracle"
    return TrialSpec.from_mapping(
        {
            "env": {"name": env, "horizon": 40},
            "policy": {"name": policy},
            "model": {"name": "linear" if linear else "mlp", **model},
            "learner": {"name": "recursive_least_squares" if linear else "adam_window"},
            "seed": 3,
        }
    )


@pytest.mark.parametrize("policy", ["d_optimal", "oracle", "random"])
def test_looking_on_the_way_changes_nothing(policy: str) -> None:
    spec = specification(policy=policy)
    seen, whole = rerun(spec, [0, 7, 8, 40]), run_trial(spec)
    np.testing.assert_array_equal(seen.states, whole.states)
    np.testing.assert_array_equal(seen.parameters[-1], whole.parameters)
    assert seen.steps.tolist() == [0, 7, 8, 40]


def test_the_first_look_is_at_the_initial_parameters() -> None:
    shorter = rerun(specification(), [0])
    assert np.abs(shorter.parameters[0]).max() <= 1.0
    assert rerun(specification(), []).parameters.shape == (0, 353)


def test_a_trial_that_diverges_is_seen_until_then() -> None:
    for path in ("kernel", "reference"):
        mapping = {**specification(policy="random").to_mapping(), "path": path}
        env = {**mapping["env"], "state_limit": 0.4}  # type: ignore[dict-item]  # a section
        spec = TrialSpec.from_mapping({**mapping, "env": env})
        seen, whole = rerun(spec, [0, 3, 40]), run_trial(spec)
        assert whole.diverged_at is not None
        assert 3 < whole.diverged_at < 40
        assert seen.steps.tolist() == [0, 3]
        np.testing.assert_array_equal(seen.states, whole.states)


def test_steps_begin_with_the_first() -> None:
    with pytest.raises(SpecificationError, match="step -3 was asked for, but the first is 0"):
        rerun(specification(), [-3, 10])


def test_steps_must_ascend() -> None:
    with pytest.raises(SpecificationError, match="do not ascend"):
        rerun(specification(), [5, 5])


@pytest.mark.parametrize("env", KNOWN_EFFECT)
@pytest.mark.parametrize("model", [{"depth": 1, "width": 5}, {"depth": 3, "width": 4}, None])
def test_prediction_is_that_of_the_reference(env: str, model: dict[str, object] | None) -> None:
    spec = specification(env) if model is None else specification(env, **model)
    if model is None:
        spec = specification(env, policy="oracle")
    rng = np.random.default_rng(1)
    theta = rng.normal(size=spec.model.n_parameters(spec.system))
    states = rng.normal(size=(6, spec.system.n_states))
    reference = model_of_one(spec.system, spec.model)
    expected = [reference(torch.tensor(theta), torch.tensor(x)).numpy() for x in states]
    predicted = spec.model.predict(spec.system, theta, states)
    np.testing.assert_allclose(predicted, expected, rtol=1e-10, atol=1e-12)
