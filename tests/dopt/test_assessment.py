"""Assessments of a trial, which are the same however it runs."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from dopt import assessment
from dopt.assessment import MEASURES, assess
from dopt.kernel import run
from dopt.limits import VIOLATIONS, WORST
from dopt.result import TrialResult
from dopt.run import rerun, run_trial
from dopt.spec.trial import TrialSpec
from orchestrate.executors.base import Task
from orchestrate.executors.lockstep import run_batch
from tests.dopt.trials import trial

SHORT = {
    "name": "control",
    "checkpoints": [10],
    "steps": 12,
    "settle_steps": 2,
    "samples": 8,
    "elites": 2,
    "lookahead": 3,
}


def short(env: str, policy: str, seed: int = 1, **task: object) -> TrialSpec:
    return TrialSpec.from_mapping(
        {**trial(env, policy, seed).to_mapping(), "task": {**SHORT, **task}}
    )


@pytest.fixture(scope="module")
def done() -> TrialResult:
    return run_trial(short("pendulum", "d_optimal"))


def test_every_measure_is_there_at_every_step(done: TrialResult) -> None:
    found = [(row.t, row.measure) for row in done.assessments]
    once = ("true_model_success", "true_model_cost")
    others = (*once, "feedback_success", "feedback_cost", VIOLATIONS, WORST)
    often = [name for name in MEASURES if name not in others]
    expected = {(0, name) for name in once} | set(itertools.product((0, 10, 30), often))
    assert len(found) == len(set(found))
    assert set(found) == expected


def test_the_parameters_are_those_of_the_replay(done: TrialResult) -> None:
    again = rerun(short("pendulum", "d_optimal"), [10, 30])
    np.testing.assert_array_equal(done.checkpoints[10], again.parameters[0])
    np.testing.assert_array_equal(done.checkpoints[30], done.parameters)


def test_pieces_and_repetition_change_nothing(
    done: TrialResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "FIRST_STEPS", 3)
    monkeypatch.setattr(run, "PIECE_SECONDS", 1e-9)
    assert run_trial(short("pendulum", "d_optimal")).assessments == done.assessments


def test_exploration_does_not_notice_that_it_is_assessed(done: TrialResult) -> None:
    plain = run_trial(trial("pendulum", "d_optimal", 1))
    assert plain.assessments == ()
    for name in ("loss", "reachable_loss", "states", "inputs", "parameters"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(done, name))


def test_the_other_steps_change_nothing(done: TrialResult) -> None:
    more = run_trial(short("pendulum", "d_optimal", checkpoints=[5, 10, 20])).assessments
    assert set(done.assessments) < set(more)


def test_both_paths_and_the_batch_agree(done: TrialResult) -> None:
    spec = short("pendulum", "d_optimal")
    spec = dataclasses.replace(spec, config=dataclasses.replace(spec.config, path="reference"))
    alone = run_trial(spec).assessments
    tasks = [Task(one.trial_key, one) for one in (spec, spec.with_seed(2))]
    batch = run_batch(tasks, "cpu")[0].outcome
    assert isinstance(batch, TrialResult)
    for rows in (alone, batch.assessments):
        assert [row[:2] for row in rows] == [row[:2] for row in done.assessments]
        np.testing.assert_allclose(
            [row.value for row in rows], [row.value for row in done.assessments], rtol=1e-6
        )


def test_policies_of_one_seed_share_what_is_not_theirs(done: TrialResult) -> None:
    other = run_trial(short("pendulum", "random")).assessments
    shared = [row for row in done.assessments if row.t == 0]
    assert [row for row in other if row.t == 0] == shared
    assert [row for row in other if row.t] != [row for row in done.assessments if row.t]
    assert run_trial(short("pendulum", "random", 2)).assessments[1] != other[1]


def test_what_policies_share_is_not_computed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    first = run_trial(short("pendulum", "random", 7))
    episodes = []
    whole = assessment.run_episode

    def counted(*arguments: object) -> object:
        episodes.append(arguments)
        return whole(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(assessment, "run_episode", counted)
    second = run_trial(short("pendulum", "d_optimal", 7))
    assert len(episodes) == 2  # of those after 0, 10 and 30 steps and with the true model
    assert [row for row in second.assessments if row.t == 0] == [
        row for row in first.assessments if row.t == 0
    ]


def test_with_the_true_model_learned_both_costs_are_one() -> None:
    spec = short("pendulum", "oracle")
    truth = [getattr(spec.system, name) for name in spec.system.linear_parameters]
    rows = assess(spec, _task(spec), {0: np.array(truth)}, np.zeros((1, 2)))
    values = {row.measure: row.value for row in rows}
    assert values["control_cost"] == pytest.approx(values["true_model_cost"], rel=1e-9)
    assert values["free_run_error"] < 1e-12
    assert values["coverage"] == 1 / 400


def test_nothing_is_said_of_what_a_diverged_trial_did_not_reach() -> None:
    spec = short("pendulum", "random", checkpoints=[1, 30])
    low = dataclasses.replace(spec.system, state_limit=0.4)
    result = run_trial(TrialSpec(dataclasses.replace(spec.config, system=low), 1))
    assert result.diverged_at is not None
    assert 1 < result.diverged_at < 30
    assert {row.t for row in result.assessments} == {0, 1}


def _task(spec: TrialSpec) -> assessment.Control:
    assert spec.task is not None
    return spec.task
