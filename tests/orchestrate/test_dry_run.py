"""Preview of a grid by ``launch.dry_run=true``."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.orchestrate.test_command_line import SHORT, Command
from tests.pages import commands
from tests.paths import ROOT


def test_a_dry_run_shows_the_grid_and_makes_no_database(
    command_line: Command, tmp_path: Path
) -> None:
    grid = ("-m", "policy=random", "width=8,16", "seed=range(4)", *SHORT)
    code, output, _ = command_line(*grid, "launch.dry_run=true")
    assert code == 0
    assert list(tmp_path.iterdir()) == []
    assert re.search(r"pendulum +random, .*width 8 +4 +0 +0 +4\n", output)
    assert "8 trials, 0 done, 8 to run" in output
    command_line(*grid, "seed=range(3)")
    assert "8 trials, 6 done, 2 to run" in command_line(*grid, "launch.dry_run=true")[1]


def test_a_dry_run_counts_trials_that_run_again(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failed(dict[str, str]):
        def get(self, _key: str, _default: object = None) -> str:  # type: ignore[override]
            return "failed"

    monkeypatch.setattr("orchestrate.runner.start._statuses", lambda _: Failed())
    grid = ("-m", "policy=random", "seed=range(4)", "launch.dry_run=true", *SHORT)
    assert "4 trials, 0 done, 0 to run" in command_line(*grid)[1]
    assert "4 trials, 0 done, 4 to run" in command_line(*grid, "launch.retry=failed")[1]


def test_a_dry_run_tells_its_configs_apart(command_line: Command) -> None:
    _, output, _ = command_line(
        "-m", "env=arm,pendulum", "policy=random", "env.mass=2,3", "env.dt=0.01,0.02", "seed=0",
        "launch.dry_run=true",
    )  # fmt: skip
    assert "env.mass applies to env=pendulum only\n" in output
    assert re.search(r"env +configuration +trials", output)
    assert re.search(r"arm +random, dt=0.01 +1", output)
    assert re.search(r"pendulum +random, .*mass=3 +1", output)
    assert "6 trials" in output


def test_width_reaches_the_model_and_a_model_without_width_runs_once(
    command_line: Command,
) -> None:
    _, output, _ = command_line(
        "-m", "policy=random,oracle", "width=4,8", "seed=0", "launch.dry_run=true"
    )
    assert re.search(r"random, width 4 .* 1\n", output)
    assert re.search(r"random, width 8 .* 1\n", output)
    assert len(re.findall("oracle", output)) == 1


SHOWN = {word for command in commands("launch.py") for word in command.words}
"""Words of the commands on the pages, which ``tests/test_docs.py`` gives."""


def test_every_experiment_is_a_grid(command_line: Command) -> None:
    """Those of the pages are run there; a setting of one grid is not said to hold for others."""
    said = {}
    for path in (ROOT / "conf" / "experiment").glob("*.yaml"):
        name = f"experiment={path.stem}"
        if path.stem == "beyond" or name not in SHOWN:
            code, output, errors = command_line("-m", name, "seed=0", "launch.dry_run=true")
            assert code == 0, errors
            assert re.search(r"[1-9][\d,]* trials, 0 done", output)
            said[path.stem] = output
    assert said["beyond"].startswith("learner.forgetting applies to learner=ekf only\n")
