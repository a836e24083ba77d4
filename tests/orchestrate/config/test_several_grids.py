"""An experiment that asks for several grids at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

Command = Callable[..., tuple[int, str, str]]

SEVERAL = """
# @package _global_
hydra:
  sweeper:
    params: {env: arm, seed: "range(0,3)"}
    grids:
      - {policy: "random,uniform"}
      - {policy: uniform, env: "arm,pendulum"}
"""


@pytest.fixture
def several(tmp_path: Path) -> tuple[str, ...]:
    """Return the words that choose an experiment of two grids, which share the uniform arm."""
    folder = tmp_path / "settings/experiment"
    folder.mkdir(parents=True)
    (folder / "several.yaml").write_text(SEVERAL)
    return "--config-dir", str(folder.parent), "experiment=several"


def test_an_experiment_can_be_several_grids(
    command_line: Command, several: tuple[str, ...]
) -> None:
    code, output, errors = command_line("-m", *several, "launch.dry_run=true")
    assert (code, errors) == (0, "")
    assert "9 trials, 0 done, 9 to run" in output  # 2 × 3 and 2 × 3, of which 3 are the same


def test_values_of_a_grid_are_those_of_yaml(command_line: Command, tmp_path: Path) -> None:
    folder = tmp_path / "settings/experiment"
    folder.mkdir(parents=True)
    values = "{policy: beyond/task, policy.goal: [1, 0.5], policy.count: 3, seed: 7}"
    words = f"# @package _global_\nhydra:\n  sweeper:\n    grids: [{values}]\n"
    (folder / "typed.yaml").write_text(words)
    given = ("-m", "--config-dir", str(folder.parent), "experiment=typed")
    code, output, errors = command_line(*given, "launch.dry_run=true")
    assert (code, errors) == (0, "")
    assert "1 trial, 0 done, 1 to run" in output


def test_a_word_of_the_command_line_holds_for_every_grid(
    command_line: Command, several: tuple[str, ...]
) -> None:
    code, output, _ = command_line("-m", *several, "seed=5", "env=pendulum", "launch.dry_run=true")
    assert code == 0
    assert "2 trials, 0 done, 2 to run" in output


def test_several_grids_are_no_single_trial(command_line: Command, several: tuple[str, ...]) -> None:
    code, _, errors = command_line(*several, "seed=5", "env=pendulum", "launch.dry_run=true")
    assert code == 2
    assert "experiment=several is a grid (policy=uniform): add -m" in errors


def test_a_setting_holds_for_the_grids_that_have_it(
    command_line: Command, several: tuple[str, ...]
) -> None:
    """And what is said of it does not count the grids that never asked for it."""
    more = ("-m", *several, "policy.iterations=3", "launch.dry_run=true")
    code, output, errors = command_line(*more)
    assert (code, errors) == (0, "")
    assert output.startswith("policy.iterations applies to policy=uniform only\n")
    code, _, errors = command_line("-m", *several, "policy.iteratons=3", "launch.dry_run=true")
    assert code == 2
    assert "did you mean 'iterations'? Choose one of iterations." in errors
