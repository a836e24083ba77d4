"""Gymnasium in both directions, and environments that break its rules."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from dopt.errors import IncompatibleError, SpecificationError
from dopt.evaluation import evaluation_set
from dopt.models import MLP
from dopt.offline_fit import recorded_samples
from dopt.reference.batch import run_trials
from dopt.run import rerun, run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.paths import EXAMPLE

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gymnasium")

import dopt.gymnasium  # noqa: E402
from tests.dopt.custom_environments import DRAG, PIECE, SEEN, TAKEN  # noqa: E402

POINT = "tests.dopt.custom_environments.Point"
SMALL = {"name": "mlp", "width": 8}
IDS = [f"dopt/{''.join(map(str.capitalize, name.split('_')))}-v0" for name in SYSTEMS]


def specification(
    target: str = POINT, policy: str = "d_optimal", seed: int = 0, **env: Any
) -> TrialSpec:
    return TrialSpec.from_names({"_target_": target, **env}, policy, model=SMALL, seed=seed)


@pytest.mark.parametrize("identity", IDS)
@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space")  # inputs are in their units
def test_a_system_passes_the_checker_of_gymnasium(identity: str) -> None:
    from gymnasium.utils.env_checker import check_env

    check_env(gymnasium.make(identity).unwrapped)


@pytest.mark.parametrize("name", ["quadrotor", "drifting_pendulum"])
def test_an_environment_steps_the_system_with_bounded_energy(name: str) -> None:
    """And changes as its system does."""
    environment = dopt.gymnasium.Exploration({"name": name, "noise": 0.0})
    system = environment.system
    state, _ = environment.reset(seed=0)
    np.testing.assert_array_equal(state, system.initial_state)
    u = np.full(system.n_inputs, system.gamma)
    for t in range(100):
        reached, _, _, _, said = environment.step(u)
        assert np.linalg.norm(said["input"]) == pytest.approx(system.gamma)
        np.testing.assert_allclose(said["input"] / u, said["input"][0] / u[0])
        expected = state + system.dt * system.derivative(state, said["input"], t)
        np.testing.assert_allclose(reached, expected, rtol=1e-9, atol=1e-12)
        state = reached


def test_the_reward_is_the_information_about_random_features() -> None:
    """Its sum is half the log determinant of the whole information matrix over the first one."""
    environment = dopt.gymnasium.Exploration(SYSTEMS["pendulum"]())
    state, _ = environment.reset(seed=3)
    states, rewards = [state], []
    for _ in range(20):
        state, reward, *_ = environment.step(environment.action_space.sample())
        states.append(state)
        rewards.append(reward)
    p, units = 3, 64
    layer = MLP(width=units).initial_parameters(environment.system, np.random.default_rng(0))
    weights, biases = layer[: p * units].reshape(units, p), layer[p * units : (p + 1) * units]
    hidden = np.tanh(environment.system.featurize(np.array(states)) @ weights.T + biases)
    h = np.column_stack([hidden, np.ones(len(states))])
    first = 1e-3 * np.eye(units + 1) + np.outer(h[0], h[0])
    gain = np.linalg.slogdet(first + h[1:].T @ h[1:])[1] - np.linalg.slogdet(first)[1]
    assert sum(rewards) == pytest.approx(gain / 2, rel=1e-6)
    assert min(rewards) > 0


def test_an_environment_ends_where_the_system_diverges_or_the_horizon_is_reached() -> None:
    small = dopt.gymnasium.Exploration({"name": "pendulum", "state_limit": 0.01})
    small.reset(seed=0)
    ends = [small.step(np.array([2.0]))[2] for _ in range(5)]
    assert any(ends)
    environment = gymnasium.make("dopt/Arm-v0")
    environment.reset(seed=0)
    flags = [environment.step(np.zeros(2))[2:4] for _ in range(SYSTEMS["arm"]().horizon)]
    assert flags[-1] == (False, True)
    assert not any(truncated for _, truncated in flags[:-1])


def test_transitions_of_a_black_box_show_its_accelerations() -> None:
    system = specification().system
    points = evaluation_set(system)
    assert points.n_grid == 50
    assert len(points.states) > 50
    np.testing.assert_allclose(points.accelerations, -DRAG * points.states[:, 1:], atol=1e-5)


def test_where_a_black_box_can_be_driven_is_not_known() -> None:
    mapping = specification().to_mapping()
    with pytest.raises(IncompatibleError, match=r"policy\.states is 'reachable', .* to grid"):
        TrialSpec.from_mapping({**mapping, "policy": {"name": "task", "states": "reachable"}})
    with pytest.raises(IncompatibleError, match="a task goes with a system with equations"):
        TrialSpec.from_mapping(mapping | {"task": {"name": "control"}})
    with pytest.raises(SpecificationError, match="unknown"):
        specification().system.learned(np.zeros((1, 2)))


def test_the_seed_decides_about_the_start_and_policies_share_it() -> None:
    short: dict[str, Any] = {"horizon": 20}
    first, second = (run_trial(specification(policy=p, **short)) for p in ("random", "d_optimal"))
    other = run_trial(specification(seed=1, **short))
    assert first.states[0, 0] == second.states[0, 0] != other.states[0, 0]
    again = rerun(specification(**short), [0, 20])
    np.testing.assert_array_equal(second.states, again.states)
    np.testing.assert_array_equal(second.parameters, again.parameters[1])


@pytest.mark.parametrize("policy", ["d_optimal", "uniform", "random"])
def test_the_kernel_steps_a_black_box_as_the_reference_does(policy: str) -> None:
    """The reference takes the steps of all seeds together."""
    specs = [specification(policy=policy, seed=seed, horizon=20) for seed in range(3)]
    for together, spec in zip(run_trials(specs), specs, strict=True):
        alone = run_trial(spec)
        assert spec.config.path == "kernel"
        np.testing.assert_allclose(together.states, alone.states, rtol=1e-9)
        np.testing.assert_allclose(together.inputs, alone.inputs, atol=1e-9)
        np.testing.assert_allclose(together.loss, alone.loss, rtol=1e-6)
        np.testing.assert_allclose(together.reachable_loss, alone.reachable_loss, rtol=1e-6)


def test_a_black_box_whose_known_part_does_not_compile_runs_on_the_reference() -> None:
    spec = specification("tests.dopt.custom_environments.Interpreted", horizon=5)
    assert spec.config.path == "reference"
    np.testing.assert_allclose(run_trial(spec).loss, run_trial(specification(horizon=5)).loss)
    with pytest.raises(SpecificationError, match=r"known of custom_environments\.py does not comp"):
        run_trial(specification("tests.dopt.custom_environments.Mistaken"))


def test_an_episode_that_ends_is_a_trial_that_diverged() -> None:
    spec = specification(id="dopt_tests/Walled-v0", policy="random_held", horizon=200)
    result = run_trial(spec)
    assert result.diverged_at is not None
    assert np.isfinite(result.loss[: result.diverged_at]).all()
    assert np.isnan(result.loss[result.diverged_at :]).all()


def test_an_angle_is_followed_over_the_full_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    spec = specification("swing.Swing", "random_held")
    states = run_trial(spec).states
    assert np.abs(np.diff(states[:, 0])).max() < 8.0 * spec.system.dt * (1 + 1e-5)
    points = evaluation_set(spec.system)
    assert np.abs(points.states[:, 0]).max() > math.pi
    slow = np.abs(points.states[:, 1]) < 7.0  # beyond 8 rad/s the environment cuts the rate
    truth = 15.0 * np.sin(points.states[slow, :1])
    np.testing.assert_allclose(points.accelerations[slow], truth, atol=1e-4)


@pytest.mark.parametrize(
    ("env", "sentence"),
    [
        ({"id": "Pendulun-v1"}, "Gymnasium cannot make .*Pendul"),
        ({"id": "dopt_tests/Buttons-v0"}, r"are Discrete\(3\), but a Box of 1 numbers"),
        ({"gamma": 3.0}, "env.gamma is 3, but the actions of .* go to 2 only"),
        ({"dt": 0.05}, "env.dt is 0.05 s, but a step of .* takes 0.1 s"),
        ({"noise": 0.1}, "env.noise is 0.1, but to point none can be added"),
        ({"initial_state": [0.0, 0.0]}, "env.initial_state is given, but point starts where"),
        ({"target": "tests.dopt.custom_environments.Blurred"}, r"makes a state of shape \(1,\)"),
        ({"grid_points": [2, 2]}, "env.grid_points has 2 entries"),
        ({"restarts": 1}, r"env\.restarts is .* true or false"),
        ({"restarts": None}, r"env\.restarts is .* true or false"),
        ({"id": "dopt_tests/Single-v0", "restarts": True}, "its episode at its first step"),
    ],
)
def test_a_wrong_environment_is_refused_in_a_sentence(env: dict[str, Any], sentence: str) -> None:
    target = env.pop("target", POINT)
    with pytest.raises(SpecificationError, match=sentence):
        run_trial(specification(target, **env))


def rough(
    identity: str,
    policy: str = "d_optimal",
    learner: Any = "gauss_newton",
    seed: int = 0,
    **env: Any,
) -> TrialSpec:
    """Return a trial of a point mass far from everything."""
    section = {"_target_": POINT, "id": f"dopt_tests/{identity}-v0", "horizon": 30, **env}
    section |= {"grid_half_widths": [60.0]}
    return TrialSpec.from_names(section, policy, model=SMALL, learner=learner, seed=seed)


@pytest.mark.parametrize("gamma", [1.0, 1.5, 2.0])
def test_what_was_applied_is_recorded_and_learned_from(gamma: float) -> None:
    """Actions are cut to whole numbers towards 0, so that none is larger than γ."""
    spec = rough("Whole", "uniform", gamma=gamma)
    TAKEN.clear()
    result = run_trial(spec)
    # Other runs belong to the evaluation, where it is not known yet.
    assert any(np.array_equal(result.inputs, np.array(taken, float)) for taken in TAKEN)
    assert set(result.inputs.ravel()) <= {-2.0, -1.0, 0.0, 1.0, 2.0}
    assert np.abs(result.inputs).max() <= gamma
    seen = recorded_samples(spec.system, result.states, result.inputs)
    np.testing.assert_allclose(seen.accelerations, -DRAG * result.states[:-1, 1:], atol=1e-9)
    assert result.loss[-1] < 0.3 * result.loss[0]


def test_inputs_are_recorded_in_the_precision_of_the_actions() -> None:
    result = run_trial(rough("Point", "random"))
    np.testing.assert_array_equal(result.inputs, result.inputs.astype(np.float32))
    speeds, inputs = result.states[:, 1], result.inputs[:, 0]
    single = inputs.astype(np.float32) - DRAG * speeds[:-1]
    np.testing.assert_allclose(speeds[1:], speeds[:-1] + 0.1 * single, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("identity", ["Writing", "OneBuffer"])
def test_arrays_that_are_written_again_make_no_difference(identity: str) -> None:
    result, usual = run_trial(rough(identity)), run_trial(rough("Point"))
    np.testing.assert_array_equal(result.inputs, usual.inputs)
    np.testing.assert_array_equal(result.states, usual.states)


@pytest.mark.parametrize(
    ("identity", "sentence"),
    [
        ("OldReset", r"fails when it is tried out \(TypeError.*older than Gymnasium 0\.26"),
        ("FourValues", r"tried out \(ValueError.*terminated, truncated and info"),
        ("NotFinite", r"shows the state \[nan nan\] after \d+ random inputs of norm 2"),
        ("Failing", "the simulator has gone"),
        ("Tau", r"env\.dt is 0\.1 s, but a step of .* takes 0\.02 s"),
        ("OneSided", r"go from \[0\.\] to \[2\.\], but ranges with 0 inside are expected"),
        ("Seedless", r"reaches other states with the same seed and inputs.*self\.np_random"),
        ("Shaken", "reaches other states with the same seed"),
        ("Truncating", rf"truncates its episode at step {PIECE}, .*\+\+env\.restarts=true"),
        ("Restarting", rf"truncates its episode at step {PIECE}, .*\+\+env\.restarts=true"),
    ],
)
def test_one_sentence_before_the_first_trial(identity: str, sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence) as caught:
        rough(identity)
    assert "\n" not in str(caught.value)
    if identity == "Truncating":  # a horizon below the truncation needs no restart
        assert run_trial(rough(identity, horizon=PIECE - 1)).diverged_at is None


def test_restarts_are_no_part_of_the_key_unless_they_are_asked_for() -> None:
    usual, asked = rough("Point"), rough("Point", restarts=True)
    assert "restarts" not in json.loads(usual.config_json)["env"]
    assert json.loads(asked.config_json)["env"]["restarts"] is True
    assert TrialSpec.from_mapping(usual.to_mapping()).config_key == usual.config_key


@pytest.mark.parametrize("identity", ["Truncating", "Restarting"])
def test_nothing_is_taught_across_a_restart(identity: str) -> None:
    noting = {"_target_": "tests.dopt.custom_environments.Noting"}
    spec = rough(identity, "random", noting, restarts=True)
    result = run_trial(spec)
    states, inputs, accelerations = SEEN
    assert len(states) == 30
    np.testing.assert_allclose(accelerations, -DRAG * states[:, 1:], atol=1e-4)
    np.testing.assert_array_equal(states, result.states[:-1])
    np.testing.assert_array_equal(inputs, result.inputs)
    jumps = np.flatnonzero(np.abs(np.diff(result.states[:, 1])) > 10)
    assert len(jumps) >= 2, "the pieces begin far apart"
    with pytest.raises(SpecificationError, match="does not say where it restarted"):
        recorded_samples(spec.system, result.states, result.inputs)


@pytest.mark.parametrize("learner", ["gauss_newton", "adam_replay"])
def test_learners_fit_the_pieces(learner: str) -> None:
    """The jumps between them, taken for accelerations, are beyond ten times the true ones."""
    for seed in range(2):
        result = run_trial(rough("Near", "random", learner, seed=seed, restarts=True))
        assert result.loss[-1] < 0.5 * result.loss[0]
        assert np.array_equal(
            run_trial(rough("Near", "random", learner, seed=seed, restarts=True)).states,
            result.states,
        )


def test_the_torch_path_does_not_explore_in_pieces() -> None:
    spec = rough("Near", "random", {"name": "adam_window"}, restarts=True)
    with pytest.raises(IncompatibleError, match=r"env\.restarts runs in the compiled kernel alone"):
        run_trial(spec, "reference")


def test_the_loss_of_pieces_is_taken_within_them() -> None:
    points = evaluation_set(rough("Restarting", restarts=True).system)
    np.testing.assert_allclose(points.accelerations, -DRAG * points.states[:, 1:], atol=1e-4)
    assert len(points.states) > 60
