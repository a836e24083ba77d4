"""Job of ``executor=slurm``: its script, and what the script does where SLURM's programs answer.

The same with a real SLURM is in ``tests/machines/test_slurm.py``.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from orchestrate.errors import LaunchError
from orchestrate.executors.slurm import TASK, SlurmOptions
from orchestrate.store import Reader
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS, until

CommandLine = Callable[..., tuple[int, str, str]]

GRID = ("-m", "env=pendulum", "policy=random", "env.horizon=5", "seed=range(10)", "executor=slurm")
DRY = "launch.dry_run=true"

ANSWERS = {
    "sbatch": 'cat >script; echo "$DOPT_DB $PYTHONPATH" >environment; '
    '[[ ! $REFUSAL ]] || { echo "sbatch: error: $REFUSAL" >&2; exit 1; }; echo "7;here"',
    "sinfo": "echo $HOSTS",
    "squeue": '[[ $* == *%T ]] && echo "$STATE" || date --date="+1 hour" +%FT%T',
    "scontrol": 'echo "scontrol $*" >>calls',
    "scancel": 'echo "scancel $*" >>calls',
}
"""Programs that take the place of SLURM's own, by name."""


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Put stand-ins for the programs of SLURM on PATH; return the folder of their notes."""
    programs = tmp_path / "programs"
    programs.mkdir()
    for name, body in ANSWERS.items():
        (programs / name).write_text(f"#!/bin/bash\n{body}\n")
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setenv("HOSTS", socket.gethostname())
    return tmp_path


def test_a_dry_run_prints_the_script_and_needs_no_slurm(command_line: CommandLine) -> None:
    code, output, errors = command_line(
        *GRID, DRY, "executor.cpus_per_task=4", "executor.tasks=8", "executor.time=55m",
        "executor.memory_gib=1.5", "executor.partition=long", "executor.account=lab",
        "+executor.options.qos=low", "+executor.options.exclusive=true",
        "+executor.options.comment='a \"b\"'", "launch.lease=90",
        "launch.memory_gib=1", "launch.retry_memory=1.5",
    )  # fmt: skip
    assert code == 0, errors
    lines = [line for line in output.splitlines() if line.startswith("#SBATCH ")]
    assert {word for line in lines for word in re.findall(r"(?<= )--.*?(?= --|$)", line)} == {
        "--job-name=dopt", "--array=1-3", "--nodes=1", "--ntasks=1", "--cpus-per-task=4",
        "--time=55", "--mem=1536M", "--partition=long", "--account=lab", "--requeue",
        "--output=results/slurm/%A_%a.log", "--open-mode=append", "--signal=B:USR1@60",
        "--export=ALL", "--qos=low", "--exclusive", '--comment="a \\"b\\""',
    }  # fmt: skip
    command = "-m orchestrate work --processes 4 --timeout 3600 --lease 90"
    assert f"{command} --memory-gib 1 --retry-memory 1.5)" in output


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("tasks", 0, "executor.tasks is 0"),
        ("tasks", None, "executor.tasks is None, but a whole number above 0"),
        ("cpus_per_task", 1.5, "executor.cpus_per_task is 1.5"),
        ("time", "4m", "executor.time is '4m', but a time from 5m on"),
        ("time", "1:00:00", "executor.time is '1:00:00', but a time from 5m on"),
        ("memory_gib", -1, "executor.memory_gib is -1"),
        ("partition", "a b", "executor.partition is 'a b', but null or a name"),
        ("logs", "", "executor.logs is ''"),
        ("options", {"part": "x"}, "--partition is set by executor.partition"),
        ("options", {"signal": "x"}, "every job sets --signal as its workers need it"),
        ("options", {"Q": "x"}, "a long name of an option of sbatch"),
        ("options", {"qos": ["x"]}, "executor.options.qos is ['x']"),
        ("options", {"exclusive": False}, "executor.options.exclusive is False"),
        ("options", {"comment": "a\nb"}, "executor.options.comment is 'a\\nb'"),
    ],
)
def test_what_is_refused(key: str, value: object, sentence: str) -> None:
    given = OmegaConf.to_container(OmegaConf.load(ROOT / "conf/executor/slurm.yaml"))
    assert isinstance(given, dict)
    with pytest.raises(LaunchError, match=re.escape(sentence)):
        SlurmOptions.from_mapping({**given, key: value})


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("launch.workers=3", "set executor.cpus_per_task, and leave launch.workers out"),
        ("launch.share=1/3", "executor=slurm needs the whole grid in one database"),
        ("launch.until=ci<5%", "but executor=slurm leaves before there are any"),
    ],
)
def test_what_does_not_go_with_slurm(command_line: CommandLine, word: str, sentence: str) -> None:
    code, output, errors = command_line(*GRID, DRY, word)
    assert (code, output, errors.count("\n")) == (2, "", 1)
    assert sentence in errors


def test_a_launch_registers_the_grid_and_submits_one_array(
    command_line: CommandLine, cluster: Path
) -> None:
    code, output, errors = command_line(*GRID, "executor.cpus_per_task=4")
    assert code == 0, errors
    assert "0 of 10 already done, 10 registered" in output
    assert "job 7: 3 tasks of 4 processes for 60 minutes" in output
    assert "python -m orchestrate status --db sqlite:///results/results.db" in output
    assert (cluster / "results/slurm").is_dir()
    assert (cluster / "script").read_text().splitlines()[0] == "#!/bin/bash"
    url, path = (cluster / "environment").read_text().split()
    assert url == "sqlite:///results/results.db"
    assert str(ROOT) in path.split(":")


@pytest.mark.parametrize(
    ("reason", "code"),
    [
        ("Invalid partition name specified", 2),
        ("Unable to contact slurm controller (connect failure)", 75),
    ],
)
def test_a_refused_job_leaves_the_grid_registered(
    command_line: CommandLine,
    cluster: Path,
    monkeypatch: pytest.MonkeyPatch,
    reason: str,
    code: int,
) -> None:
    monkeypatch.setenv("REFUSAL", f"Batch job submission failed: {reason}")
    given, _, errors = command_line(*GRID)
    assert (given, errors.count("\n")) == (code, 1)
    assert f"sbatch takes no job ({reason}), but the grid is registered" in errors
    with Reader.open(f"sqlite:///{cluster}/results/results.db") as reader:
        assert reader.rows("SELECT count(*) FROM trial WHERE status = 'pending'")[0][0] == 10


def test_a_folder_that_cannot_be_made_is_named(command_line: CommandLine, cluster: Path) -> None:
    (cluster / "file").touch()
    code, _, errors = command_line(*GRID, "executor.logs=file/logs")
    assert (code, errors.count("\n")) == (2, 1)
    assert "executor.logs is 'file/logs', a folder that cannot be made (Not a directory)" in errors


def test_nodes_that_do_not_see_a_file_are_named(
    command_line: CommandLine, cluster: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTS", f"{socket.gethostname()} node1 node2")
    code, _, errors = command_line(*GRID)
    assert code == 2
    assert "is a file of this machine, which the nodes node1, node2 do not see" in errors
    assert not (cluster / "results").exists()


def test_a_machine_without_slurm_and_a_single_trial_are_refused(
    command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    assert "submits a job by sbatch, which is not on PATH here" in command_line(*GRID)[2]
    assert "executor=slurm is for grids" in command_line("env=pendulum", "executor=slurm")[2]


class ArrayTask:
    """The script of a task that runs, with workers that do as they are told."""

    def __init__(self, folder: Path, workers: str, state: str) -> None:
        self._calls = folder / "calls"
        self._said = folder / "said"
        script = folder / "job"
        before = f"workers=(bash {folder / 'workers'})\nwalltime=3600 leave=120\n"
        script.write_text(before + TASK.read_text())
        (folder / "workers").write_text(workers)
        given = {"SLURM_JOB_ID": "7", "SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "3"}
        with self._said.open("w") as said:
            self.process = subprocess.Popen(
                ["bash", str(script)],
                cwd=folder,
                env={**os.environ, **given, "STATE": state},
                stdout=said,
            )

    def until_said(self, words: str) -> None:
        until(lambda: words in self._said.read_text(), self._said.read_text)

    def end(self) -> tuple[int, str, list[str]]:
        """Return the exit code, what the workers said, and the commands to SLURM."""
        code = self.process.wait(PATIENCE_SECONDS)
        calls = self._calls.read_text().splitlines() if self._calls.exists() else []
        return code, self._said.read_text(), calls


WARNED = """
trap 'echo "warned"; sleep 0.2; exit 130' USR1
echo "$@"
while :; do sleep 0.05; done
"""


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTERM])
@pytest.mark.parametrize("state", ["RUNNING", "COMPLETING"])
def test_a_warned_task_is_queued_again_unless_slurm_has_stopped_it(
    cluster: Path, number: signal.Signals, state: str
) -> None:
    task = ArrayTask(cluster, WARNED, state)
    task.until_said("--until")
    task.process.send_signal(number)
    code, said, calls = task.end()
    assert code > 128
    assert said.count("warned") == 1
    assert calls == (["scontrol requeue 7_3"] if state == "RUNNING" else [])


@pytest.mark.parametrize("code", [0, 1, 2, 3, 75])
def test_a_complete_grid_needs_no_more_tasks(cluster: Path, code: int) -> None:
    start = time.monotonic()
    given, said, calls = ArrayTask(cluster, f'echo "$@"; exit {code}', "RUNNING").end()
    assert given == code
    assert calls == (["scancel --quiet --state=PENDING 7"] if code <= 1 else [])
    seconds = int(said.removeprefix("--until ").strip().removesuffix("s"))
    took = time.monotonic() - start  # from one second to the same, or to the next one
    assert 3600 - 120 - took - 1 <= seconds <= 3600 - 120
