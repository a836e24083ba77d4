"""The grey box: the system's equations with unknown parameters, where linear and where not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt.assessment import parameter_error
from dopt.errors import IncompatibleError
from dopt.run import rerun, run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.trials import trial


def grey(
    system: str, policy: str, model: dict[str, Any], learner: dict[str, Any], **fields: Any
) -> TrialSpec:
    return trial(system, policy, 0, model={"name": "grey_box"} | model, learner=learner, **fields)


@pytest.mark.parametrize("env", ["pendulum_unknown_gain", "cartpole", "quadrotor"])
def test_with_linear_parameters_it_is_the_linear_model(env: str) -> None:
    """The filter of both takes the same steps; an effect of the inputs is a parameter as others."""
    filtered = {"name": "ekf", "regularization": 1e-3}
    linear = trial(env, "random", 0, model={"name": "linear"}, learner=filtered)
    q = linear.model.n_parameters(linear.system)
    box = grey(env, "random", {"initial": [0.0] * q, "spread": 0.0}, filtered)
    one, other = (run_trial(spec) for spec in (linear, box))
    assert other.parameters == pytest.approx(one.parameters, rel=1e-6, abs=1e-9)
    assert other.loss == pytest.approx(one.loss, rel=1e-6, abs=1e-9)


def test_parameters_that_enter_nonlinearly_are_found() -> None:
    spec = grey(
        "moving_star",
        "random",
        {"unknown": ["radius", "core"], "initial": [0.4, 0.05], "spread": 0.0},
        {"name": "gauss_newton", "regularization": 1e-8, "steps": 3},
        env={"period": 1e6, "initial_state": [0.87, 0.0], "noise": 0.0},
    )
    found = rerun(spec, [1, 30]).parameters
    errors = [parameter_error(spec.system, theta, 0, ["radius", "core"]) for theta in found]
    assert errors[1] < 1e-4 < 0.05 < errors[0]


def test_a_moving_star_is_followed_by_a_fit_of_the_newest_samples() -> None:
    names = ["center_x", "center_y"]
    spec = grey(
        "moving_star",
        "random",
        {"unknown": names, "initial": [0.95, 0.05], "spread": 0.0},
        {"name": "gauss_newton", "capacity": 5, "regularization": 1e-8, "steps": 3},
    )
    (theta,) = rerun(spec, [30]).parameters
    assert parameter_error(spec.system, theta, 29, names) < 0.03
    assert parameter_error(spec.system, theta, 0, names) > 0.1


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ({"unknown": ["gravity", "weight"]}, r"model\.unknown goes with names out of mass, length"),
        ({"unknown": ["gravity", "gravity"]}, "none of them twice"),
        ({"unknown": ["gravity"], "initial": [1.0, 2.0]}, "one number for each of gravity"),
    ],
)
def test_unknown_parameters_are_the_systems_own(model: dict[str, Any], words: str) -> None:
    with pytest.raises(IncompatibleError, match=words):
        grey("pendulum", "random", model, {"name": "adam"})


def test_initial_parameters_scatter_about_the_guess_by_the_seed() -> None:
    spec = grey("pendulum", "random", {"unknown": ["mass"], "initial": [2.0]}, {"name": "adam"})
    drawn = [
        spec.model.initial_parameters(spec.system, np.random.default_rng(seed))[0]
        for seed in range(200)
    ]
    assert np.mean(drawn) == pytest.approx(2.0, abs=0.03)
    assert np.std(drawn) == pytest.approx(0.1, rel=0.2)
