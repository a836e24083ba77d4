"""Space filling: its values against sums and loops that are written out, and what it covers."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from dopt.policies.held_candidates import SpaceFilling, SpaceFillingPlan
from dopt.run import run_trial
from dopt.systems import SYSTEMS
from dopt.trial_view import Array, TrialView
from tests.dopt.trials import trial

CRITERIA = ("gsx", "igs", "idw")


class Straight(TrialView):
    """A trial of the pendulum whose model is a plain function of the point."""

    def __init__(self, t: int, *, reads_inputs: bool = False) -> None:
        rng = np.random.default_rng(t)
        self.system, self.t = SYSTEMS["pendulum"](), t
        self.states, self.inputs = rng.normal(size=(t + 1, 2)), rng.normal(size=(t, 1))
        self.sampled_inputs, self.sampled = self.inputs, self.states[:-1]
        self.accelerations = 3.0 * rng.normal(size=(t, 1))
        self.parameters, self.tie = np.zeros(1), np.array([1.0])
        self._reads_inputs = reads_inputs

    def points(self, states: Array, inputs: Array) -> Array:
        return np.concatenate([states, inputs], axis=1) if self._reads_inputs else states

    def predict(self, states: Array) -> Array:
        return states.sum(axis=1, keepdims=True) ** 2

    def following(self, state: Array, inputs: Array) -> Array:
        return state + np.array([0.1, 0.3]) * inputs

    def jacobian(self, state: Array) -> Array:
        raise NotImplementedError

    def jacobian_change(self, state: Array, directions: Array) -> Array:
        raise NotImplementedError

    def input_matrix(self, state: Array) -> Array:
        raise NotImplementedError


def written_out(policy: SpaceFilling, view: Straight, u: float) -> float:
    """Return the worth of an input, sample by sample."""
    system, gamma = view.system, view.system.gamma
    state = view.states[-1]
    for _ in range(policy.lookahead):
        state = view.following(state, np.array([[u]]))[0]
    point = view.points(state[None], np.array([[u]]))
    scale = float(view.accelerations.std())
    pairs = []
    for x, v, y in zip(view.sampled, view.inputs, view.accelerations, strict=True):
        there = view.points(x[None], v[None])
        gap = system.featurize(state[None]) - system.featurize(x[None])
        apart = float(np.sum(gap**2)) + float(np.sum((point - there)[0, 2:] ** 2)) / gamma**2
        pairs.append((apart, float((view.predict(point)[0, 0] - y[0]) / scale) ** 2))
    if policy.criterion == "gsx":
        return math.sqrt(min(apart for apart, _ in pairs))
    if policy.criterion == "igs":
        return min(math.sqrt(apart * differing) for apart, differing in pairs)
    weights = [math.exp(-apart) / apart for apart, _ in pairs]
    spread = sum(w * differing for w, (_, differing) in zip(weights, pairs, strict=True))
    distance = math.atan(1 / sum(weights)) * 2 / math.pi
    return spread / sum(weights) + policy.weight * distance


@pytest.mark.parametrize(
    ("criterion", "lookahead", "reads_inputs"),
    list(itertools.product(CRITERIA, (1, 3), (False, True))),
)
def test_an_input_is_worth_what_its_formula_says(
    criterion: str, lookahead: int, reads_inputs: bool
) -> None:
    policy = SpaceFilling(criterion=criterion, lookahead=lookahead, weight=0.7)
    for t in (2, 9, 40):
        view = Straight(t, reads_inputs=reads_inputs)
        plan = SpaceFillingPlan(policy, view.system)
        gamma = view.system.gamma
        expected = [written_out(policy, view, u) for u in (gamma, -gamma)]
        np.testing.assert_allclose(plan.worth(view, np.array([[gamma], [-gamma]])), expected)
        assert plan.choose(view)[0] == (gamma if expected[0] > expected[1] else -gamma)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_equal_worth_is_decided_by_the_random_direction(criterion: str) -> None:
    for tie in (1.0, -1.0):
        view = Straight(5)
        view.following = lambda state, inputs: np.repeat(state[None], len(inputs), 0)  # type: ignore[method-assign]
        view.tie = np.array([tie])
        plan = SpaceFillingPlan(SpaceFilling(criterion=criterion), view.system)
        assert plan.choose(view)[0] == tie * view.system.gamma


def test_a_place_that_was_seen_is_worth_nothing_new() -> None:
    """At a sample itself the inverse distance has no weight left, and no number is infinite."""
    view = Straight(5)
    view.following = lambda _, inputs: np.repeat(view.sampled[:1], len(inputs), 0)  # type: ignore[method-assign]
    inputs = np.array([[1.0]])
    for criterion in ("gsx", "igs"):
        plan = SpaceFillingPlan(SpaceFilling(criterion=criterion), view.system)
        assert plan.worth(view, inputs)[0] == 0.0
    gap = (view.predict(view.sampled[:1]) - view.accelerations[:1]) / view.accelerations.std()
    plan = SpaceFillingPlan(SpaceFilling(criterion="idw"), view.system)
    assert plan.worth(view, inputs)[0] == pytest.approx(float(gap[0, 0]) ** 2, rel=1e-6)


def test_far_from_all_samples_the_numbers_stay_finite() -> None:
    view = Straight(5)
    view.following = lambda state, inputs: state + 1e3 * inputs  # type: ignore[method-assign]
    plan = SpaceFillingPlan(SpaceFilling(criterion="idw"), view.system)
    assert np.isfinite(plan.worth(view, np.array([[1.0], [-1.0]]))).all()


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_both_paths_choose_the_same_inputs(env: str, criterion: str) -> None:
    spec = trial(env, "space_filling", 2, policy={"criterion": criterion}, env={"horizon": 25})
    kernel, reference = run_trial(spec), run_trial(spec, "reference")
    np.testing.assert_allclose(kernel.inputs, reference.inputs, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(kernel.states, reference.states, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_it_sees_more_of_the_circle_than_random_inputs(criterion: str) -> None:
    seen: dict[str, float] = {}
    for name, fields in (("random", {}), ("space_filling", {"criterion": criterion})):
        policy: dict[str, Any] = dict(fields)
        result = run_trial(trial("pendulum", name, 1, policy=policy, env={"horizon": 300}))
        seen[name] = float(np.ptp(result.states[:, 0]))
    assert seen["space_filling"] > 1.5 * seen["random"]
