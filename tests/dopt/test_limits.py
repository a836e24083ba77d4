"""Limits of inputs and states, and sensors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from dopt import Explorer
from dopt.control import Control
from dopt.errors import IncompatibleError, ScaleWarning, SpecificationError
from dopt.kernel.run import KernelTrial, SteppedTrial
from dopt.kernel.structs import Record
from dopt.limits import Limits
from dopt.randomness import draw
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.explorer.plants import following
from tests.dopt.explorer.test_measurements import ENCODER, JOINT
from tests.dopt.trials import trial

RAIL: dict[str, Any] = {"bounds": {"y": [-2.0, 2.0]}}
TIGHT: dict[str, Any] = {"bounds": {"y": [-0.3, 0.3], "u": [-5.0, 6.0]}, "rates": {"u": 150.0}}


def limited(
    env: str, limits: object, policy: str = "d_optimal", /, *, horizon: int = 60, seed: int = 0,
    **fields: Any,
) -> TrialSpec:  # fmt: skip
    spec = trial(env, policy, seed, env={"horizon": horizon, **fields})
    return TrialSpec.from_mapping(spec.to_mapping() | {"limits": limits})


def measures(result: TrialResult) -> dict[str, float]:
    return {row.measure: row.value for row in result.assessments}


@pytest.mark.parametrize("policy", ["d_optimal", "random", "uniform", "periodic"])
def test_inputs_stay_within_their_box_and_rates(policy: str) -> None:
    spec = limited("cartpole", TIGHT, policy)
    inputs = run_trial(spec).inputs[:, 0]
    changes = np.diff(np.concatenate([[0.0], inputs]))
    assert inputs.min() >= -5.0
    assert inputs.max() <= 6.0
    assert np.abs(changes).max() == pytest.approx(150.0 * spec.system.dt)


def test_a_model_that_is_right_breaks_no_bound() -> None:
    """The oracle's model is exact after a few samples, so that no margin is needed."""
    limits = {"bounds": {"y": [-1.5, 1.5]}, "margin": 0.0}
    result = run_trial(limited("cartpole", limits, "oracle", horizon=300, noise=0.0))
    assert measures(result) == {"violations": 0.0, "worst": 0.0}
    assert np.abs(result.states[:, 0]).max() > 0.75


def test_limits_that_are_not_enforced_change_nothing_and_are_counted() -> None:
    assert "measured" not in limited("cartpole", None).config_json
    counted = run_trial(limited("cartpole", TIGHT | {"enforced": False}, horizon=200))
    plain = run_trial(limited("cartpole", None, horizon=200))
    assert np.array_equal(counted.inputs, plain.inputs)
    assert np.array_equal(counted.loss, plain.loss)
    beyond = np.abs(plain.states[1:, 0]) - 0.3
    assert measures(counted)["violations"] == np.count_nonzero(beyond > 0)
    assert measures(counted)["worst"] == pytest.approx(beyond.max())
    assert measures(counted)["violations"] > 10
    assert plain.assessments == ()


def test_bounds_that_nothing_reaches_change_nothing() -> None:
    wide = {"bounds": {"y": [-1e6, 1e6], "u": [-100.0, 100.0]}, "rates": {"u": 1e6}}
    wide_trial, plain = (run_trial(limited("cartpole", given)) for given in (wide, None))
    assert np.array_equal(wide_trial.inputs, plain.inputs)
    assert np.array_equal(wide_trial.parameters, plain.parameters)


def test_an_explorer_fed_the_states_of_a_trial_chooses_its_inputs() -> None:
    spec = limited("cartpole", TIGHT)
    result = run_trial(spec)
    explorer = Explorer(spec.system, limits=TIGHT)
    for x, after, u in zip(result.states, result.states[1:], result.inputs, strict=False):
        assert explorer.ask(x) == pytest.approx(u, abs=1e-12)
        explorer.tell(after)


def test_rates_are_counted_from_the_last_answer() -> None:
    """Also where nothing was learned after it, and from an input that was applied instead."""
    explorer = Explorer(limited("cartpole", None).system, limits={"rates": {"u": 50.0}})
    x, before = np.array([0.0, 0.0, np.pi, 0.0]), 0.0
    for k in range(12):
        u = explorer.ask(x + 0.01 * k)[0]  # each state is a jump
        assert abs(u - before) <= 50.0 * 0.02 + 1e-12
        before = u
    explorer.tell(x, applied=[3.0])
    assert abs(explorer.ask(x)[0] - 3.0) <= 50.0 * 0.02 + 1e-12


def test_an_input_of_others_beyond_the_bounds_widens_none() -> None:
    limits = {"bounds": {"u": [-1.0, 1.0]}, "rates": {"u": 1.0}}
    explorer = Explorer(limited("cartpole", None).system, limits=limits)
    x = np.array([0.0, 0.0, np.pi, 0.0])
    explorer.ask(x)
    explorer.tell(x + 1e-3, applied=[500.0])
    assert abs(explorer.ask(x + 1e-3)[0]) <= 1.0


def test_states_beyond_a_bound_count_after_a_reset() -> None:
    explorer = Explorer(limited("cartpole", None).system, limits=RAIL)
    x = np.array([0.0, 0.0, np.pi, 0.0])
    explorer.ask(x)
    explorer.tell(np.array([2.5, 0.0, np.pi, 0.0]))
    explorer.reset()
    explorer.ask(x)
    explorer.tell(x)
    rows = {row.measure: row.value for row in explorer._result(None).assessments}
    assert rows == {"violations": 1.0, "worst": pytest.approx(0.5)}


def test_violations_of_a_diverged_trial_are_those_before() -> None:
    counted = RAIL | {"enforced": False, "bounds": {"ẏ": [-0.5, 0.5]}}
    result = run_trial(limited("cartpole", counted, "random", state_limit=3.5, horizon=300))
    assert result.diverged_at is not None
    speeds = np.abs(result.states[1:, 1])
    beyond = speeds[np.isfinite(speeds)] - 0.5
    assert measures(result)["violations"] == np.count_nonzero(beyond > 0) > 0
    assert measures(result)["worst"] == pytest.approx(beyond.max())


def test_sections_describe_their_limits() -> None:
    spec = limited("cartpole", TIGHT | {"steps": 20})
    assert TrialSpec.from_mapping(spec.to_mapping()) == spec
    assert spec.limits == Limits(
        bounds=(("y", -0.3, 0.3), ("u", -5.0, 6.0)), rates=(("u", 150.0),), steps=20
    )
    assert Limits(bounds=(("y", -1, 1),)) == limited("cartpole", {"bounds": {"y": (-1, 1)}}).limits
    with pytest.raises(SpecificationError, match=r"bounds\.y is \[2\.0, -2\.0\]"):
        Limits(bounds=(("y", 2.0, -2.0),))
    one_sided = limited("cartpole", {"bounds": {"y": [None, np.int64(2)]}}).limits
    assert one_sided is not None
    assert one_sided.to_section()["bounds"] == {"y": [None, 2.0]}
    assert limited("cartpole", {"name": "none"}).limits is None
    assert "limits" not in limited("cartpole", None).config_json


WRONG = [
    (RAIL | {"margins": 1}, "limits.box field 'margins' is unknown: did you mean 'margin'"),
    ({"bounds": {"x": [-1, 1]}}, "state or input in limits.bounds 'x' is unknown"),
    ({"bounds": {"y": [1, -1]}}, r"limits\.bounds\.y is \[1, -1\], but a pair of numbers"),
    ({"bounds": {"y": 2.0}}, r"limits\.bounds\.y is 2\.0, but a pair"),
    ({"bounds": {"y": ["a", 2]}}, r"limits\.bounds\.y is .* but a pair"),
    ({"bounds": {"u": [1, 2]}}, r"limits\.bounds\.u is .* but an interval with 0 in it"),
    ({"bounds": [2.0]}, r"limits\.bounds is \[2\.0\], but a mapping of names"),
    ({"rates": {"y": 1.0}}, "input in limits.rates 'y' is unknown"),
    ({"rates": {"u": 0.0}}, r"limits\.rates\.u is 0\.0, but a number above 0"),
    ({"rates": {"u": True}}, r"limits\.rates\.u is True"),
    (RAIL | {"steps": 0}, r"limits\.steps is 0 steps, but it has to be"),
    (RAIL | {"margin": -1.0}, r"limits\.margin is -1\.0"),
    (RAIL | {"enforced": "no"}, r"limits\.enforced is 'no', but true or false"),
    ({"bounds": {}}, "limits have neither a bound nor a rate, .* choose limits=none"),
    ({"bounds": {"y": [None, None]}}, "limits have neither a bound nor a rate"),
    ({"bounds": 0}, r"limits\.bounds is 0, but a mapping of names"),
    ({"bounds": {"y": [-(10**400), 1]}}, r"limits\.bounds\.y is .* but a pair"),
    ({"rates": {"u": 10**400}}, r"limits\.rates\.u is .* but a number above 0"),
    ("rail", "configuration key 'limits' is 'rail', but a section"),
    ({"name": "sphere"}, "limits 'sphere' is unknown.* one of box, none"),
    ({"bounds": [("y",)]}, r"limits\.bounds is \[\('y',\)\], but a mapping of names"),
    (Control(), "configuration key 'limits' is Control"),
]


@pytest.mark.parametrize(("given", "message"), WRONG)
def test_wrong_limits_are_refused_in_a_sentence(given: object, message: str) -> None:
    with pytest.raises(SpecificationError, match=message) as caught:
        limited("cartpole", given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", [{}, "control", Limits(bounds=(("y", -1.0, 1.0),))])
def test_what_is_no_task_is_refused(given: object) -> None:
    with pytest.raises(SpecificationError, match="task"):
        TrialSpec.from_mapping({**trial("cartpole", "random").to_mapping(), "task": given})


DEGREE = math.pi / 180
ANGLE = {"measured_states": [0], "measurement_noise": [DEGREE]}
CART = {"measured_states": [2, 0], "measurement_noise": [DEGREE, 0.01]}
JOINTS = {"measured_states": [0, 2], "measurement_noise": [DEGREE, DEGREE]}


def sensed(
    env: str, sensors: dict[str, Any], learner: str = "joint_ekf", policy: str = "d_optimal", /, *,
    horizon: int = 30, seed: int = 0, **fields: Any,
) -> TrialSpec:  # fmt: skip
    parts: dict[str, dict[str, Any]] = {"env": {"horizon": horizon, **sensors}}
    parts["policy"] = {"regularization": 3.0} if policy == "d_optimal" else {}
    refits = {"refit_every": 12} if learner == "joint_ekf" else {}
    parts["learner"] = {"name": learner, **refits, **fields}
    return trial(env, policy, seed, model={"name": "mlp"}, **parts)


ABSOLUTE = {"output_matrix": [1, 0, 0, 0, 1, 0, 1, 0], "measurement_noise": [DEGREE, DEGREE]}
"""Of an arm the angles of both links against the base."""


def test_what_is_measured_is_the_state_with_its_noise() -> None:
    spec = sensed("pendulum", ANGLE, "adam", horizon=400, seed=4)
    noise = draw(spec).measurement_noise
    assert noise.shape == (400, 1)
    assert 0.9 * DEGREE < noise.std() < 1.1 * DEGREE
    fast = KernelTrial(sensed("pendulum", ANGLE, "adam", horizon=5))
    fast.advance(5)
    seen = fast.state.estimate.outputs[:, 0] - fast.record.true_states[1:, 0]
    np.testing.assert_allclose(seen, draw(fast.spec).measurement_noise[:5, 0], atol=1e-15)


def observed(spec: TrialSpec) -> tuple[Record, Array]:
    """Return the record of a trial, and the accelerations that a learner in numpy observes."""
    learner = {"learner": {"_target_": "tests.dopt.custom_plugins.Descent"}}
    fast = SteppedTrial(TrialSpec.from_mapping(spec.to_mapping() | learner))
    fast.advance(spec.system.horizon)
    assert fast._parts is not None
    return fast.record, fast._parts.targets


EXACT = {"measurement_noise": [1e-13], "noise": 0.0}


@pytest.mark.parametrize(
    ("env", "sensors"),
    [
        ("pendulum", {"measured_states": [0]}),
        ("pendulum", {"measured_states": [0], "integrator": "rk4"}),
        ("cartpole", {"measured_states": [0, 1, 2], "measurement_noise": [1e-13] * 3}),
        ("pendulum", {"measured_states": [0, 1], "measurement_noise": [1e-13] * 2}),
    ],
)
def test_estimates_belong_together(env: str, sensors: dict[str, Any]) -> None:
    """Without noise and in small motions, what is learned at an estimate is a(x̂)."""
    sensors = EXACT | {"gamma": 0.05} | sensors  # small motions, of which a(x) is linear
    spec = sensed(env, sensors, "adam", "periodic", horizon=300)
    system, (record, targets) = spec.system, observed(spec)
    truth = system.learned(system.sampled_states(record.states))
    errors, sizes = (targets - truth)[100:], truth[100:]  # once the filters have settled
    late = np.sqrt(np.mean(errors**2)) / np.sqrt(np.mean(sizes**2))
    assert late < 0.01


def test_a_trial_that_diverges_has_no_estimates_from_there_on() -> None:
    sensors = ANGLE | {"state_limit": 0.05}
    result = run_trial(sensed("pendulum", sensors, horizon=60, refit_every=1000))
    assert result.diverged_at is not None
    assert result.estimated_states is not None
    assert np.isnan(result.estimated_states[result.diverged_at :]).all()
    assert np.isfinite(result.estimated_states[: result.diverged_at]).all()


REFUSED = [
    ({"measured_states": [2], "measurement_noise": [0.1]}, "joint_ekf", "indices from 0 to 1"),
    ({"measured_states": [0, 0], "measurement_noise": [0.1] * 2}, "joint_ekf", "none twice"),
    ({"measured_states": [0]}, "joint_ekf", "measurement_noise has 0 entries"),
    ({"measured_states": [0], "measurement_noise": [0.0]}, "joint_ekf", "above 0"),
    (ANGLE | {"velocity_cutoff": 0.0}, "adam", "above 0"),
    (ANGLE | {"output_matrix": [1.0, 0.0]}, "joint_ekf", "one of the two is expected"),
    ({"output_matrix": [1.0], "measurement_noise": [0.1]}, "joint_ekf", "2 for each output"),
    ({"output_matrix": [0, 0], "measurement_noise": [0.1]}, "joint_ekf", "no row of 2 zeros"),
    ({"output_matrix": [1, 1]}, "joint_ekf", "0 entries, but pendulum needs 1"),
]


@pytest.mark.parametrize(("sensors", "learner", "said"), REFUSED)
def test_sensors_that_make_no_sense_are_refused(
    sensors: dict[str, Any], learner: str, said: str
) -> None:
    with pytest.raises(SpecificationError, match=said):
        sensed("pendulum", sensors, learner)


def test_what_does_not_go_with_sensors_is_refused() -> None:
    with pytest.raises(IncompatibleError, match="'joint_ekf' goes with states that are measured"):
        TrialSpec.from_names("pendulum", "d_optimal", learner="joint_ekf")  # and no warning
    rate = {"measured_states": [1], "measurement_noise": [0.1]}
    with pytest.raises(IncompatibleError, match="does not say that a state is the rate"):
        sensed("pendulum", rate, "adam")


def test_a_prior_that_says_nothing_is_warned_of() -> None:
    mapping: dict[str, Any] = sensed("pendulum", ANGLE, seed=5).to_mapping()
    with pytest.warns(ScaleWarning, match=r"variance 1e\+03, .* set policy.regularization to 3"):
        TrialSpec.from_mapping(mapping | {"policy": {"name": "d_optimal", "regularization": 1e-3}})


def test_it_learns_from_the_angle_alone() -> None:
    """More than from filtered differences, and D-optimal inputs more than random ones."""
    grid = {"grid_points": [16, 16]}
    joint, differences, random = (
        run_trial(sensed("pendulum", ANGLE | grid, *parts, horizon=300, seed=1000, **fields))
        for parts, fields in (
            (("joint_ekf",), {"refit_every": 100}),
            (("gauss_newton",), {"noise_variance": 100.0, "refit_every": 5}),
            (("joint_ekf", "random"), {"refit_every": 100, "regularization": 3.0}),
        )
    )
    assert joint.loss[-1] < 0.5 * differences.loss[-1]
    assert joint.loss[-1] < 0.5 * random.loss[-1]


def test_a_matrix_that_selects_states_measures_them() -> None:
    rows = {"output_matrix": [0, 0, 1, 0, 1, 0, 0, 0], "measurement_noise": [DEGREE, 0.01]}
    selected, given = (
        run_trial(sensed("cartpole", sensors, horizon=20)) for sensors in (CART, rows)
    )
    assert np.array_equal(selected.inputs, given.inputs)
    assert np.array_equal(selected.parameters, given.parameters)
    changed = ABSOLUTE | {"output_matrix": [1, 0, 0, 0, 1, 0, 2, 0]}
    specs = [sensed("arm", sensors) for sensors in (JOINTS, ABSOLUTE, changed)]
    assert len({spec.config_key for spec in specs}) == 3


def test_a_mixture_of_states_needs_a_learner_that_estimates_them() -> None:
    mixed = {"output_matrix": [1, 0.1], "measurement_noise": [0.1]}
    with pytest.raises(IncompatibleError, match=r"output_matrix goes with .* 'joint_ekf'"):
        sensed("pendulum", mixed, "adam")
    with pytest.raises(SpecificationError, match="an explorer is told states"):
        Explorer(sensed("pendulum", mixed).system, learner="joint_ekf")


def test_a_plant_of_which_the_angle_is_measured_stays_within_its_stops() -> None:
    """Also while its rate is unknown at first; ``violations`` count the estimates."""
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
    mapping = sensed("cartpole", CART, "adam_window").to_mapping()
    TrialSpec.from_mapping(mapping | {"limits": RAIL | {"enforced": False}})
    with pytest.raises(IncompatibleError, match="which knows how uncertain its estimates are"):
        TrialSpec.from_mapping(mapping | {"limits": RAIL})
