"""A launch whose output nobody reads any longer."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from orchestrate.store import Reader
from tests.orchestrate.test_command_line import SHORT
from tests.paths import ROOT

LAUNCH = [str(ROOT / "orchestrate/launch.py"), "-m", "policy=random", "seed=0,1", *SHORT]


@pytest.mark.parametrize("worker", [False, True])
def test_a_grid_goes_on_when_its_output_is_closed(tmp_path: Path, worker: bool) -> None:
    """As by ``| head``."""
    url = f"sqlite:///{tmp_path}/results/results.db"
    words = LAUNCH
    if worker:
        leave = [sys.executable, *LAUNCH, "launch.detach=true"]
        subprocess.run(leave, cwd=tmp_path, check=True, capture_output=True)
        words = ["-m", "orchestrate", "work", "--db", url]
    with subprocess.Popen(
        [sys.executable, *words], cwd=tmp_path, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert "rror" not in process.stderr.read()
    assert process.returncode == 0
    with Reader.open(url) as reader:
        rows = reader.query("SELECT count(*) FROM trial WHERE status = 'done'")
        assert [tuple(row) for row in rows] == [(2,)]
