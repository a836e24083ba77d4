"""docs/example/slurm_workers.sh where SLURM's programs, and the workers, answer as they are told.

The same with a real SLURM is in ``tests/machines/test_slurm.py``.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS, until

ANSWERS = {
    "squeue": '[[ $* == *%T ]] && echo "$STATE" || date --date="+1 hour" +%FT%T',
    "scontrol": 'echo "scontrol $*" >>calls',
    "scancel": 'echo "scancel $*" >>calls',
}
"""Programs that take the place of SLURM's own, by name."""

Start = Callable[[str, str], subprocess.Popen[str]]


@pytest.fixture
def start(tmp_path: Path) -> Start:
    """Return a function that starts the script of a task, for its workers and its state."""

    def run(workers: str, state: str) -> subprocess.Popen[str]:
        for name, body in {**ANSWERS, "python": f'echo "$@" >said\n{workers}'}.items():
            (tmp_path / name).write_text(f"#!/bin/bash\n{body}\n")
            (tmp_path / name).chmod(0o755)
        given = {"SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "3", "SLURM_CPUS_PER_TASK": "4"}
        path = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "STATE": state}
        command = ["bash", str(ROOT / "docs/example/slurm_workers.sh"), "--lease=90"]
        return subprocess.Popen(command, cwd=tmp_path, env={**os.environ, **given, **path})

    return run


def calls(folder: Path) -> list[str]:
    """Return the commands to SLURM."""
    return (folder / "calls").read_text().splitlines() if (folder / "calls").exists() else []


WARNED = """
trap 'echo warned >>said; sleep 0.2; exit 130' USR1
echo ready >>said
while :; do sleep 0.05; done
"""


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTERM])
@pytest.mark.parametrize("state", ["RUNNING", "COMPLETING"])
def test_a_warned_task_is_queued_again_unless_slurm_has_stopped_it(
    start: Start, tmp_path: Path, number: signal.Signals, state: str
) -> None:
    task, said = start(WARNED, state), tmp_path / "said"
    until(lambda: said.exists() and "ready" in said.read_text())
    task.send_signal(number)
    assert task.wait(PATIENCE_SECONDS) > 128
    assert said.read_text().count("warned") == 1
    assert calls(tmp_path) == (["scontrol requeue 7_3"] if state == "RUNNING" else [])


@pytest.mark.parametrize("code", [0, 1, 2, 3, 75])
def test_a_complete_grid_needs_no_more_tasks(start: Start, tmp_path: Path, code: int) -> None:
    began = time.monotonic()
    assert start(f"exit {code}", "RUNNING").wait(PATIENCE_SECONDS) == code
    assert calls(tmp_path) == (["scancel --quiet --state=PENDING 7"] if code <= 1 else [])
    *words, length, lease = (tmp_path / "said").read_text().split()
    assert [*words, lease] == ["-m", "orchestrate", "work", "--processes=4", "--lease=90"]
    seconds = int(length.removeprefix("--until=").removesuffix("s"))
    took = time.monotonic() - began  # from one second to the same, or to the next one
    assert 3600 - 120 - took - 1 <= seconds <= 3600 - 120
