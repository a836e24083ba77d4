"""A setting holds for those choices of a grid that have it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

Command = Callable[..., tuple[int, str, str]]

SHORT = ("env.horizon=5", "executor=local", "launch.workers=1")


def test_a_setting_holds_for_the_choices_that_have_it(command_line: Command) -> None:
    code, output, errors = command_line(
        "-m", "env=arm", "policy=random,uniform,d_optimal", "policy.regularization=1e-2,1e-3",
        "model.depth=1", "seed=0,1", "launch.dry_run=true",
    )  # fmt: skip
    assert (code, errors) == (0, "")
    assert "policy.regularization applies to policy=d_optimal only\n" in output
    assert "model.depth" not in output
    assert "8 trials, 0 done, 8 to run" in output  # 2 random, 2 uniform, 4 D-optimal


@pytest.mark.parametrize(
    ("choice", "setting", "note"),
    [
        ("policy=beyond/exact,beyond/trace", "policy.budget_us=20", ""),
        ("policy=d_optimal,beyond/exact", "policy.candidates=8", "policy=exact"),
        ("learner=ekf,adam_window", "learner.forgetting=0.99", "learner=ekf"),
        ("task=none,control", "task.steps=60", "task=control"),
    ],
)
def test_a_single_value_may_be_one_that_the_default_choice_lacks(
    command_line: Command, choice: str, setting: str, note: str
) -> None:
    code, output, errors = command_line("-m", choice, setting, "seed=0", "launch.dry_run=true")
    assert (code, errors) == (0, "")
    key = setting.partition("=")[0]
    assert output.startswith(f"{key} applies to {note} only\n") == bool(note)
    assert "2 trials, 0 done, 2 to run" in output


def test_a_setting_of_the_launch_may_refer_to_one_of_a_trial(
    command_line: Command, tmp_path: Path
) -> None:
    named = "store.url=sqlite:///of${env.horizon}.db"
    assert command_line("-m", "policy=random,oracle", "seed=0", named, *SHORT)[0] == 0
    assert (tmp_path / "of5.db").exists()


def test_a_setting_of_a_model_that_one_policy_brings_along(command_line: Command) -> None:
    code, output, _ = command_line(
        "-m", "policy=random,oracle", "model.depth=3", "seed=0", "launch.dry_run=true"
    )
    assert code == 0
    assert output.startswith("model.depth applies to model=mlp only\n")
    assert "2 trials" in output


def test_a_helper_that_another_setting_refers_to_is_read(command_line: Command) -> None:
    arguments = ("-m", "+strength=3,4", "env.gamma=${strength}", "seed=0", "launch.dry_run=true")
    code, output, errors = command_line(*arguments)
    assert (code, errors) == (0, "")
    assert "2 trials" in output
