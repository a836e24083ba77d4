"""A launch whose output nobody reads any longer."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from orchestrate.store import Reader
from tests.orchestrate.test_command_line import SHORT
from tests.paths import ROOT


def test_a_grid_goes_on_when_its_output_is_closed(tmp_path: Path) -> None:
    """As by ``| head``."""
    command = [sys.executable, str(ROOT / "orchestrate/launch.py"), "-m", "policy=random"]
    with subprocess.Popen(
        [*command, "seed=0,1", *SHORT], cwd=tmp_path, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert "rror" not in process.stderr.read()
    assert process.returncode == 0
    with Reader.open(f"sqlite:///{tmp_path}/results/results.db") as reader:
        assert [tuple(row) for row in reader.query("SELECT count(*) FROM trial")] == [(2,)]
