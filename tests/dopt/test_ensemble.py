"""Ensembles of networks: the first explores as a network alone does, and the mean is evaluated."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt.assessment import model_forecast
from dopt.control.planning import forecast_by
from dopt.errors import IncompatibleError
from dopt.evaluation import evaluation_set
from dopt.offline_fit import grid_loss
from dopt.randomness import initial_weights
from dopt.run import rerun, run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import SMALL_GRIDS, SMALL_SEARCHES

STEPS = 9
ENSEMBLE = {"name": "ensemble", "members": 4}
GAUSS_NEWTON = {"name": "gauss_newton"}


def make(
    model: dict[str, Any], policy: str = "d_optimal", learner: dict[str, Any] = GAUSS_NEWTON
) -> TrialSpec:
    env = {"name": "arm", "horizon": STEPS, "grid_points": list(SMALL_GRIDS["arm"])}
    section = {"name": policy, **SMALL_SEARCHES.get(policy, {})}
    parts = {"env": env, "policy": section, "model": model, "learner": learner}
    return TrialSpec.from_mapping({**parts, "seed": 5})


def members_of(parameters: np.ndarray) -> np.ndarray:
    return parameters.reshape(ENSEMBLE["members"], -1)


@pytest.mark.parametrize("policy", ["d_optimal", "icem"])
def test_it_explores_as_its_first_member_does_alone(policy: str) -> None:
    found, alone = run_trial(make(ENSEMBLE, policy)), run_trial(make({"name": "mlp"}, policy))
    np.testing.assert_array_equal(found.states, alone.states)
    np.testing.assert_array_equal(members_of(found.parameters)[0], alone.parameters)
    assert not np.allclose(found.loss, alone.loss)


def test_one_member_is_the_network() -> None:
    found, alone = (
        run_trial(make({"name": "ensemble", "members": 1})),
        run_trial(make({"name": "mlp"})),
    )
    for name in ("states", "parameters", "loss", "reachable_loss"):
        np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))


def test_the_others_take_turns() -> None:
    spec = make(ENSEMBLE)
    steps = rerun(spec, (0, 1, 2, 4))
    initial, one, two, four = (members_of(parameters) for parameters in steps.parameters)
    np.testing.assert_array_equal(initial, members_of(initial_weights(spec)))
    for parameters, before, learning in ((one, initial, {0, 1}), (two, one, {0, 2})):
        changed = {k for k in range(len(before)) if not np.array_equal(parameters[k], before[k])}
        assert changed == learning
    assert {k for k in range(len(two)) if not np.array_equal(four[k], two[k])} == {0, 1, 3}


def test_the_loss_is_that_of_the_mean_prediction() -> None:
    spec = make(ENSEMBLE)
    result = run_trial(spec)
    assert result.loss[-1] == pytest.approx(grid_loss(spec, result.parameters), rel=1e-5)
    states = evaluation_set(spec.system).states[:5]
    members = [
        make({"name": "mlp"}).model.predict(spec.system, theta, states)
        for theta in members_of(result.parameters)
    ]
    found = spec.model.predict(spec.system, result.parameters, states)
    np.testing.assert_allclose(found, np.mean(members, axis=0), rtol=1e-12)


def test_forecasts_follow_the_mean() -> None:
    rng = np.random.default_rng(0)
    spec = make(ENSEMBLE)
    parameters = run_trial(spec).parameters
    states, inputs = rng.standard_normal((3, 4)), rng.standard_normal((3, 6, 2))
    by_mean = forecast_by(
        spec.system, lambda x, u: spec.model.predict(spec.system, parameters, x, u)
    )
    found = model_forecast(spec.system, spec.model, parameters)(states, inputs)
    np.testing.assert_allclose(found, by_mean(states, inputs), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("learner", "words"),
    [
        ({"name": "adam_window"}, "and model 'ensemble' with learner 'gauss_newton', but the two"),
        (
            {"name": "ekf"},
            "goes with model 'mlp', 'affine', 'black_box', 'linear' or 'grey_box' and model "
            "'ensemble' with",
        ),
        ({"name": "gauss_newton", "refit_every": 2}, "but learner.refit_every 2 was given"),
    ],
)
def test_learners_that_keep_something_of_one_network_are_refused(
    learner: dict[str, Any], words: str
) -> None:
    with pytest.raises(IncompatibleError, match=words):
        make(ENSEMBLE, learner=learner)
