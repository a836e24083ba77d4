"""What a user types, and what comes back."""

from __future__ import annotations

import re
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.orchestrate.conftest import ROOT

Command = Callable[..., tuple[int, str, str]]

SHORT = ("env.horizon=5", "executor=local", "launch.workers=1")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["env=pendulm"], "env 'pendulm' is unknown.* did you mean 'pendulum'"),
        (["-m", "env=pendulm,arm"], "env 'pendulm' is unknown.* did you mean 'pendulum'"),
        (["-m", "env=glob(pend)"], "did you mean 'pendulum'"),
        (["env.gama=3"], "setting of env 'gama' is unknown.* did you mean 'gamma'"),
        (["-m", "env.gama=3,4"], "setting of env 'gama' is unknown.* did you mean 'gamma'"),
        (["evn=pendulum"], "setting 'evn' is unknown.* did you mean 'env'"),
        (["-m", "seed=range(0,0)"], "'seed=range\\(0,0\\)' has no values"),
        (["width=wide"], "model.width is 'wide' .* a whole number is expected"),
        (["-m", "width=8,wide"], "model.width is 'wide' .* a whole number is expected"),
        (["env.mass=-1"], "env.mass is -1.0 kg, but it has to be finite and above 0"),
        (["+env.colour=red"], "'colour' is unknown"),
        (["seed=-1"], "seed is -1"),
        (["seed=99999999999999999999"], "seed is 9+, but a whole number .* below 2\\^63"),
        (["env.horizon=99999999999"], "env.horizon is 9+ steps, but it has to be at most 2\\^31"),
        (["-m", "seed=range(0,1e12)"], "has more than 1,000,000 values"),
        (["policy=random", "policy.regularization=1"], "'regularization' is unknown, there is no"),
        (["seed=1,2"], "'seed=1,2' gives several values to one trial: add -m"),
        (["seed=range(3)"], "'seed=range\\(3\\)' gives several values to one trial"),
        (["launch.ray=3"], "launch.ray is 3, but a section"),
        (["width=${wdth}"], "'wdth' not found"),
        (["env=[1"], "cannot read the override 'env=\\[1'"),
        (["env=quadrotor", "policy=periodic"], "eigenmode"),
        (["executor=rey"], "executor 'rey' is unknown.* did you mean 'ray'"),
        (["launch.retry=fail"], "launch.retry 'fail' is unknown.* did you mean 'failed'"),
        (["launch.workers=0"], "launch.workers is 0, but null or a whole number above 0"),
        (["launch.dryrun=true"], "did you mean 'dry_run'"),
        (["store.url=mysql://you:secret@host/db"], "not supported"),
    ],
)
def test_a_wrong_command_is_one_sentence_and_leaves_nothing(
    command_line: Command, tmp_path: Path, arguments: list[str], words: str
) -> None:
    code, output, errors = command_line(*arguments)
    assert code == 2, output + errors
    assert output == ""
    assert re.fullmatch("error: [^\n]+\n", errors), errors
    assert re.search(words, errors), errors
    assert "secret" not in errors
    assert list(tmp_path.iterdir()) == []


def test_a_trial_prints_its_result_and_is_stored(command_line: Command, tmp_path: Path) -> None:
    arguments = ("env=arm", "policy=random", "seed=3", *SHORT)
    code, output, errors = command_line(*arguments)
    assert (code, errors) == (0, "")
    assert re.match(
        r"env=arm policy=random model=mlp width=16 seed=3 · final loss \S+ · .*5 steps", output
    )
    assert output == command_line(*arguments)[1]
    assert [path.name for path in tmp_path.iterdir()] == ["results"]


def test_a_grid_runs_once_and_the_default_is_a_hundred_seeds(command_line: Command) -> None:
    grid = ("-m", "env=glob(*)", "policy=random,periodic", *SHORT)
    code, output, _ = command_line(*grid)
    assert code == 0, output
    assert "left out 100 trials: env=quadrotor policy=periodic" in output
    assert "0 of 700 already done, 700 to run" in output
    assert "700 of 700 done, 0 failed" in output
    assert "700 of 700 already done, nothing to run" in command_line(*grid)[1]


def test_a_dry_run_shows_the_grid_and_makes_no_database(
    command_line: Command, tmp_path: Path
) -> None:
    grid = ("-m", "policy=random", "width=8,16", "seed=range(4)", *SHORT)
    code, output, _ = command_line(*grid, "launch.dry_run=true")
    assert code == 0
    assert list(tmp_path.iterdir()) == []
    assert re.search(r"pendulum +random +8 +4 +0 +0 +4\n", output)
    assert "8 trials, 0 done, 8 to run" in output
    command_line(*grid, "seed=range(3)")
    assert "8 trials, 6 done, 2 to run" in command_line(*grid, "launch.dry_run=true")[1]


def test_width_reaches_the_model_and_a_model_without_width_runs_once(
    command_line: Command,
) -> None:
    _, output, _ = command_line(
        "-m", "policy=random,oracle", "width=4,8", "seed=0", "launch.dry_run=true"
    )
    assert re.search(r"random +mlp .* 4 .* 1\n", output)
    assert re.search(r"random +mlp .* 8 .* 1\n", output)
    assert len(re.findall("oracle", output)) == 1


def test_the_database_of_the_environment(
    command_line: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("DOPT_DB", f"sqlite:///{tmp_path}/mine.db")
    assert command_line(*SHORT)[0] == 0
    assert (tmp_path / "mine.db").exists()


def test_every_experiment_is_a_grid(command_line: Command) -> None:
    for path in (ROOT / "conf" / "experiment").glob("*.yaml"):
        code, output, errors = command_line("-m", f"experiment={path.stem}", "launch.dry_run=true")
        assert code == 0, errors
        assert re.search(r"[1-9][\d,]* trials, 0 done", output)


def test_provenance_is_written_without_passwords(command_line: Command, tmp_path: Path) -> None:
    command_line("-m", "seed=1,2", "+model.note=1", *SHORT)  # refused, and not written down
    command_line("-m", "seed=1,2", "~launch.ray", "+launch.ray={address: 'ray://u:pw@h'}", *SHORT)
    with sqlite3.connect(tmp_path / "results/results.db") as connection:
        [(argv, overrides, versions)] = connection.execute(
            "SELECT argv, overrides, versions FROM launch"
        )
    connection.close()
    assert "pw" not in argv + overrides
    assert "seed=1,2" in overrides
    assert "numpy" in versions


def test_help_and_configuration(command_line: Command) -> None:
    code, output, _ = command_line("--help")
    assert code == 0
    assert "python orchestrate/launch.py" in output
    assert "env: arm, cartpole, pendulum, quadrotor" in output
    code, output, _ = command_line("--cfg", "job", "width=8")
    assert code == 0
    assert "width: 8" in output


def test_it_runs_from_any_folder_without_being_installed(tmp_path: Path) -> None:
    """The real thing, once: no output folders, no change of folder, the plugin found."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "orchestrate/launch.py"), "-m", "env=glob(*)", "seed=0",
         "launch.dry_run=true"],
        cwd=tmp_path, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "4 trials, 0 done, 4 to run" in done.stdout
    assert list(tmp_path.iterdir()) == []
