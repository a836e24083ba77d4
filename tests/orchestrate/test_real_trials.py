"""The trials themselves, not stand-ins, through every executor: the same rows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from orchestrate.runner import launch
from orchestrate.store import Reader
from tests.paths import ROOT


def words(executor: str, url: str) -> list[str]:
    """Return the words that launch two short trials of two systems, one of which changes."""
    grid = ["-m", "env=pendulum,beyond/drifting_pendulum", "policy=d_optimal", "seed=range(2)"]
    return [*grid, "env.horizon=12", f"executor={executor}", f"store.url={url}"]


def losses(url: str) -> list[float]:
    with Reader.open(url) as reader:
        configs = sorted(reader.configs(), key=lambda config: config.config_key)
        return [
            float(loss)
            for config in configs
            for loss in reader.curves(config.config_key).values.ravel().tolist()
        ]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> list[float]:
    """Return the losses of the trials one after the other in this process."""
    url = f"sqlite:///{tmp_path_factory.mktemp('alone') / 'results.db'}"
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DOPT_DB", raising=False)
        patch.setattr(sys, "argv", ["launch.py", *words("inprocess", url)])
        assert launch.main() == 0
    return losses(url)


@pytest.mark.parametrize("executor", ["local", "ray"])
@pytest.mark.xdist_group("real trials")  # one run in one process for all of them
def test_every_executor_stores_the_same_losses(
    executor: str, alone: list[float], tmp_path: Path
) -> None:
    url = f"sqlite:///{tmp_path / executor}.db"
    done = subprocess.run(
        [sys.executable, "orchestrate/launch.py", *words(executor, url)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(alone) == 48
    assert losses(url) == alone
