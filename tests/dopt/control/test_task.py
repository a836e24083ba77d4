from __future__ import annotations

import dataclasses
import json

import pytest

from dopt.control import Control
from dopt.control.task import GOALS
from dopt.errors import IncompatibleError, SpecificationError
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, Pendulum
from tests.dopt.trials import trial

TASK = {"name": "control", "checkpoints": [10, 20]}


def with_task(spec: TrialSpec, task: dict[str, object]) -> TrialSpec:
    return TrialSpec.from_mapping({**spec.to_mapping(), "task": task})


def test_the_key_of_a_trial_without_a_task_is_what_it_was() -> None:
    paper = TrialSpec.from_mapping(
        {
            "env": {"name": "pendulum"},
            "policy": {"name": "d_optimal"},
            "model": {"name": "mlp"},
            "learner": {"name": "adam_window"},
            "seed": 3,
        }
    )
    assert "task" not in json.loads(paper.canonical_json())
    assert paper.trial_key == KEY
    for nothing in ({}, {"task": None}, {"task": {"name": "none"}}):
        assert TrialSpec.from_mapping({**paper.to_mapping(), **nothing}).trial_key == KEY


KEY = "54d3df2f4ec3c5efb1bc3c3a1679d8c9528f64d9e6c775eef807cbbf8340c220"
"""Of this trial before there were tasks."""


def test_a_task_is_part_of_the_key_with_every_value() -> None:
    spec = trial("pendulum", "random", 1)
    asked = with_task(spec, TASK)
    assert asked.trial_key != spec.trial_key
    content = json.loads(asked.config_json)["task"]
    assert content["goal"] == list(Control().on(asked.system).goal)
    assert None not in content.values()
    assert TrialSpec.from_mapping(asked.to_mapping()).trial_key == asked.trial_key
    same = with_task(spec, {**TASK, "steps": Control().on(asked.system).steps})
    assert same.trial_key == asked.trial_key
    assert with_task(spec, {**TASK, "steps": 100}).trial_key != asked.trial_key


def test_the_steps_to_assess_hold_the_first_and_the_last() -> None:
    assert trial("pendulum", "random", 1).assessed_steps == ()
    spec = with_task(trial("pendulum", "random", 1), TASK)
    assert spec.assessed_steps == (0, 10, 20, 30)
    unsorted = with_task(spec, {**TASK, "checkpoints": [30, 10, 20, 10]})
    assert unsorted.assessed_steps == (0, 10, 20, 30)


@pytest.mark.parametrize("name", sorted(GOALS))
def test_the_task_of_a_shipped_system_fits_it(name: str) -> None:
    system = SYSTEMS[name]()
    goal = Control().on(system)
    assert len(goal.goal) == len(goal.initial_state) == system.n_states
    assert goal.lookahead * goal.hold <= goal.steps


@dataclasses.dataclass(frozen=True, kw_only=True)
class Swing(Pendulum):
    name = "swing"


def test_a_system_of_ones_own_is_told_what_to_give() -> None:
    with pytest.raises(IncompatibleError, match=r"'swing' has no control task.*task\.goal"):
        Control().on(Swing())
    own = Control(**vars(Control().on(Pendulum())))
    assert own.on(Swing()) == Control().on(Pendulum())


def test_a_system_that_changes_has_no_one_truth_to_be_judged_by() -> None:
    with pytest.raises(IncompatibleError, match=r"'drifting_pendulum' changes .* task=none"):
        with_task(trial("drifting_pendulum", "random"), TASK)


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"goal": [1.0]}, r"task\.goal has 1 entries, but pendulum needs 2"),
        ({"tolerances": [-1.0, 1.0]}, r"task\.tolerances\[0\] is -1\.0"),
        ({"checkpoints": [31]}, r"holds step 31, but a trial has 30 steps"),
        ({"checkpoints": [0]}, r"task\.checkpoints\[0\] is 0"),
        ({"elites": 65}, r"task\.elites is 65, but .* at most task\.samples"),
        ({"settle_steps": 401}, r"task\.settle_steps is 401, .* at most task\.steps"),
        ({"stpes": 3}, r"did you mean 'steps'\?"),
        ({"name": "contrl"}, r"did you mean 'control'\?"),
    ],
)
def test_what_makes_no_sense_is_refused(fields: dict[str, object], sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        with_task(trial("pendulum", "random"), {**TASK, **fields})
