"""The trials themselves, not stand-ins, through every executor: the same rows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from orchestrate.store import Reader
from tests.paths import ROOT


def losses(executor: str, folder: Path) -> list[float]:
    """Launch two short trials of two systems, one of which changes with time."""
    url = f"sqlite:///{folder}/{executor}.db"
    grid = ("-m", "env=pendulum,beyond/drifting_pendulum", "policy=d_optimal", "seed=range(2)")
    words = (*grid, "env.horizon=12", f"executor={executor}", f"store.url={url}")
    done = subprocess.run(
        [sys.executable, "orchestrate/launch.py", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with Reader.open(url) as reader:
        configs = sorted(reader.configs(), key=lambda config: config.config_key)
        return [
            float(loss)
            for config in configs
            for loss in reader.curves(config.config_key).values.ravel().tolist()
        ]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> list[float]:
    """Return the losses of the trials one after the other in one process."""
    return losses("inprocess", tmp_path_factory.mktemp("alone"))


@pytest.mark.parametrize("executor", ["local", "ray"])
@pytest.mark.xdist_group("real trials")  # one run in one process for all of them
def test_every_executor_stores_the_same_losses(
    executor: str, alone: list[float], tmp_path: Path
) -> None:
    assert len(alone) == 48
    assert losses(executor, tmp_path) == alone
