"""Environments that break the rules: the right numbers, or one sentence before the first trial."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from dopt.errors import IncompatibleError, SpecificationError
from dopt.evaluation import evaluation_set
from dopt.offline_fit import recorded_samples
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec

pytest.importorskip("gymnasium", reason="needs the extra gymnasium")

from tests.dopt.custom_environments import DRAG
from tests.dopt.rough_environments import PIECE, SEEN, TAKEN

LEARNERS = ("adam_window", "gauss_newton", "ekf", "adam_replay")


def specification(
    identity: str,
    policy: str = "d_optimal",
    learner: Any = "gauss_newton",
    seed: int = 0,
    **env: Any,
) -> TrialSpec:
    section = {"_target_": "tests.dopt.rough_environments.Rough", "id": f"dopt_tests/{identity}-v0"}
    return TrialSpec.from_mapping(
        {
            "env": {**section, "horizon": 30, **env},
            "policy": {"name": policy},
            "model": {"name": "mlp", "width": 8},
            "learner": {"name": learner} if isinstance(learner, str) else learner,
            "seed": seed,
        }
    )


@pytest.mark.parametrize("gamma", [1.0, 1.5, 2.0])
def test_what_was_applied_is_recorded_and_learned_from(gamma: float) -> None:
    """Actions are cut to whole numbers towards 0, so that none is larger than γ."""
    spec = specification("Whole", "uniform", gamma=gamma)
    TAKEN.clear()
    result = run_trial(spec)
    # Other runs are those of the evaluation, where it is not known yet.
    assert any(np.array_equal(result.inputs, np.array(taken, float)) for taken in TAKEN)
    assert set(result.inputs.ravel()) <= {-2.0, -1.0, 0.0, 1.0, 2.0}
    assert np.abs(result.inputs).max() <= gamma
    seen = recorded_samples(spec.system, result.states, result.inputs)
    np.testing.assert_allclose(seen.accelerations, -DRAG * result.states[:-1, 1:], atol=1e-9)
    assert result.loss[-1] < 0.3 * result.loss[0]


def test_inputs_are_recorded_in_the_precision_of_the_actions() -> None:
    result = run_trial(specification("Point", "random"))
    np.testing.assert_array_equal(result.inputs, result.inputs.astype(np.float32))
    speeds, inputs = result.states[:, 1], result.inputs[:, 0]
    single = inputs.astype(np.float32) - DRAG * speeds[:-1]
    np.testing.assert_allclose(speeds[1:], speeds[:-1] + 0.1 * single, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("identity", ["Writing", "OneBuffer"])
def test_arrays_that_are_written_again_make_no_difference(identity: str) -> None:
    result, usual = run_trial(specification(identity)), run_trial(specification("Point"))
    np.testing.assert_array_equal(result.inputs, usual.inputs)
    np.testing.assert_array_equal(result.states, usual.states)


@pytest.mark.parametrize(
    ("identity", "sentence"),
    [
        ("OldReset", r"fails when it is tried out \(TypeError.*older than Gymnasium 0\.26"),
        ("OldResetTwo", "makes a state of shape|fails when it is tried out"),
        ("FourValues", r"tried out \(ValueError.*terminated, truncated and info"),
        ("NotFinite", r"shows the state \[nan nan\] after \d+ random inputs of norm 2"),
        ("Failing", "the simulator has gone"),
        ("Tau", r"env\.dt is 0\.1 s, but a step of .* takes 0\.02 s"),
        ("OneSided", r"go from \[0\.\] to \[2\.\], but ranges with 0 inside are expected"),
        ("Seedless", r"reaches other states with the same seed and inputs.*self\.np_random"),
        ("Shaken", "reaches other states with the same seed"),
        ("ShakenByPython", "reaches other states with the same seed"),
        ("Truncating", rf"truncates its episode at step {PIECE}, .*\+\+env\.restarts=true"),
        ("Restarting", rf"truncates its episode at step {PIECE}, .*\+\+env\.restarts=true"),
    ],
)
def test_one_sentence_before_the_first_trial(identity: str, sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence) as caught:
        specification(identity)
    assert "\n" not in str(caught.value)


def test_a_horizon_below_the_truncation_is_no_restart() -> None:
    assert run_trial(specification("Truncating", horizon=PIECE - 1)).diverged_at is None


@pytest.mark.parametrize("given", [1, "yes", None])
def test_restarts_are_true_or_false(given: object) -> None:
    with pytest.raises(SpecificationError, match=r"env\.restarts is .* true or false"):
        specification("Point", restarts=given)


def test_restarts_are_no_part_of_the_key_unless_they_are_asked_for() -> None:
    usual, asked = specification("Point"), specification("Point", restarts=True)
    assert "restarts" not in json.loads(usual.config_json)["env"]
    assert json.loads(asked.config_json)["env"]["restarts"] is True
    assert TrialSpec.from_mapping(usual.to_mapping()).config_key == usual.config_key


@pytest.mark.parametrize("identity", ["Truncating", "Restarting"])
def test_nothing_is_taught_across_a_restart(identity: str) -> None:
    noting = {"_target_": "tests.dopt.rough_environments.Noting"}
    spec = specification(identity, "random", noting, restarts=True)
    result = run_trial(spec)
    states, inputs, accelerations = SEEN
    assert len(states) == 30
    np.testing.assert_allclose(accelerations, -DRAG * states[:, 1:], atol=1e-4)
    np.testing.assert_array_equal(states, result.states[:-1])
    np.testing.assert_array_equal(inputs, result.inputs)
    jumps = np.flatnonzero(np.abs(np.diff(result.states[:, 1])) > 10)
    assert len(jumps) >= 2, "the pieces begin far apart"
    with pytest.raises(SpecificationError, match="does not say where it began anew"):
        recorded_samples(spec.system, result.states, result.inputs)


@pytest.mark.parametrize("learner", ["gauss_newton", "adam_replay"])
def test_learners_fit_the_pieces(learner: str) -> None:
    """The jumps between them, taken for accelerations, are beyond ten times the true ones."""
    for seed in range(2):
        result = run_trial(specification("Near", "random", learner, seed=seed, restarts=True))
        assert result.loss[-1] < 0.5 * result.loss[0]
        assert np.array_equal(
            run_trial(specification("Near", "random", learner, seed=seed, restarts=True)).states,
            result.states,
        )


def test_the_torch_path_does_not_explore_in_pieces() -> None:
    spec = specification("Near", "random", {"name": "adam_window"}, restarts=True)
    with pytest.raises(IncompatibleError, match=r"env\.restarts runs in the compiled kernel alone"):
        run_trial(spec, "reference")


def test_the_loss_of_pieces_is_taken_within_them() -> None:
    points = evaluation_set(specification("Restarting", restarts=True).system)
    np.testing.assert_allclose(points.accelerations, -DRAG * points.states[:, 1:], atol=1e-4)
    assert len(points.states) > 60


def test_an_environment_of_single_steps_cannot_be_explored_in_pieces() -> None:
    with pytest.raises(SpecificationError, match="truncates its episode at its first step"):
        specification("Single", restarts=True)
