"""Limits of a plant whose states are estimated: its true states stay within their bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dopt import Explorer
from dopt.errors import IncompatibleError
from dopt.kernel.learners import joint_kalman
from dopt.kernel.run import KernelTrial
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from tests.dopt.explorer.plants import following
from tests.dopt.explorer.test_measured_states import DEGREE, ENCODER, JOINT
from tests.dopt.kernel.calls import call
from tests.dopt.test_limits import RAIL, measures
from tests.dopt.test_sensors import CART, augmented_filter, sensed


def limited(
    limits: dict[str, Any] | None, policy: str = "d_optimal", /, *, horizon: int = 20,
    seed: int = 0, path: str = "kernel", learner: str = "joint_ekf", **env: Any,
) -> TrialSpec:  # fmt: skip
    """Return a trial of the cartpole of which angle and place are measured."""
    spec = sensed(
        "cartpole", CART | env, learner, policy, horizon=horizon, path=path, seed=seed,
        **({"refit_every": 1000} if learner == "joint_ekf" else {}),
    )  # fmt: skip
    return TrialSpec.from_mapping(spec.to_mapping() | {"limits": limits})


def test_variances_are_those_of_state_and_parameters_in_one_filter() -> None:
    sensors = {"measured_states": [0], "measurement_noise": [DEGREE]}
    fast = KernelTrial(sensed("pendulum", sensors, horizon=13, refit_every=1000))
    fast.advance(12)
    shorter = sensed("pendulum", sensors, horizon=12, refit_every=1000)
    expected = augmented_filter(shorter).variances[:2]
    found = call(joint_kalman.state_variances, fast.trial, 12)
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def beyond(result: TrialResult) -> float:
    """Return the share of the steps after which the true cart is beyond its rail."""
    return float(np.mean(np.abs(result.states[1:, 0]) > 2.0))


def test_the_true_cart_stays_on_its_rail() -> None:
    """Counted on the true states: without limits it leaves the rail, without a margin also."""
    free, bare = (
        run_trial(limited(RAIL | given, horizon=300))
        for given in ({"enforced": False}, {"margin": 0.0})
    )
    kept = [run_trial(limited(RAIL, horizon=300, seed=seed)) for seed in range(3)]
    assert beyond(free) > 0.5
    assert sum(map(beyond, kept)) <= 0.01 * 3
    assert beyond(kept[0]) < beyond(bare)
    for result in (free, bare, *kept):
        assert measures(result)["violations"] == pytest.approx(300 * beyond(result))


def test_a_plant_of_which_the_angle_is_measured_stays_within_its_stops() -> None:
    """Also while its rate is unknown at first; ``violations`` are those of the estimates."""
    places, counts = [], []
    for enforced in (True, False):
        limits = {"bounds": {"angle": [-1.0, 1.0]}, "steps": 15, "enforced": enforced}
        explorer = Explorer(ENCODER, steps=150, limits=limits, **JOINT)
        rng, x = np.random.default_rng(0), np.array([0.1, 0.0])
        y, visited = x[:1], []
        for _ in range(150):
            x = following(x, explorer.ask(y))
            y = x[:1] + DEGREE * rng.standard_normal(1)
            explorer.tell(y)
            visited.append(abs(x[0]))
        places.append(max(visited))
        rows = {row.measure: row.value for row in explorer._result(None).assessments}
        counts.append(rows["violations"])
        assert counts[-1] == np.count_nonzero(np.abs(explorer.states[1:, 0]) > 1.0)
    assert places[0] <= 1.0 < places[1]
    assert counts[0] == 0.0 < counts[1]


def test_limits_of_filtered_differences_are_refused() -> None:
    """Nothing says how uncertain these are; limits that are counted alone need no such thing."""
    with pytest.raises(
        IncompatibleError, match="which knows how uncertain its estimates are, but l"
    ):
        limited(RAIL, learner="adam_window")
    limited(RAIL | {"enforced": False}, learner="adam_window")
