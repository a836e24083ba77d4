"""Trials that the kernel does not know, killed with their launch and taken up again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dopt.spec.config import without_versions
from dopt.spec.trial import TrialSpec
from orchestrate import launch
from orchestrate.runner import start
from orchestrate.runner.start import Work
from orchestrate.store import NoDatabaseError, Reader, StoreError
from tests.orchestrate.faults.laboratory import Rows, flaws, results
from tests.orchestrate.faults.trials import Gate, Gated
from tests.paths import ROOT
from tests.waiting import until

pytestmark = pytest.mark.xdist_group("reference launches")  # one undisturbed database

EXAMPLE = ROOT / "docs" / "example"
TRIALS = 6
PROGRAM = """
import sys
from orchestrate.launch import program
from tests.orchestrate.faults.test_reference import close_gate
close_gate(sys.argv.pop(1))
program()
"""


def words(url: str) -> list[str]:
    """Return the words of a grid of a policy and a network that only the reference runs."""
    grid = ["--config-dir", str(EXAMPLE / "conf"), "-m", "env=boat", "env.horizon=15"]
    return [
        *grid,
        "policy=curiosity",
        "model=residual",
        f"seed=range({TRIALS})",
        f"store.url={url}",
    ]


def started(url: str, folder: Path) -> subprocess.Popen[str]:
    """Start a launch whose trials pass the gate of a folder."""
    path = os.pathsep.join([str(ROOT), str(EXAMPLE)])
    program = [sys.executable, "-c", PROGRAM, str(folder), *words(url)]
    return subprocess.Popen(
        [*program, "executor=inprocess"],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def close_gate(folder: str) -> None:
    start.WORK = Work(Gated(start.WORK.run, Gate(Path(folder))), start.WORK.prepare)


def launched_here(url: str) -> int:
    """Launch in this process, which has imported everything; return the exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLE))
        patch.delenv("DOPT_DB", raising=False)
        patch.setattr(sys, "argv", ["launch.py", *words(url), "executor=inprocess"])
        return int(launch.main())


def done(url: str) -> int:
    try:
        with Reader.open(url) as reader:
            return int(reader.rows("SELECT count(*) FROM trial WHERE status = 'done'")[0][0])
    except (NoDatabaseError, StoreError):
        return 0


def numbers(url: str) -> Rows:
    """Return what the trials left, without what they took."""
    found = results(url)
    return found | {"curve": [row[:4] for row in found["curve"]]}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a database of the grid that nothing disturbed."""
    url = f"sqlite:///{tmp_path_factory.mktemp('whole') / 'results'}.db"
    assert launched_here(url) == 0
    assert done(url) == TRIALS
    return url


def test_a_killed_launch_of_reference_trials_goes_on(
    tmp_path: Path, undisturbed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    url = f"sqlite:///{tmp_path / 'killed'}.db"
    Gate(tmp_path).let(3)
    process = started(url, tmp_path)
    until(lambda: done(url) >= 2 or process.poll() is not None)
    assert process.poll() is None, process.communicate()[0]
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    before = done(url)
    assert 2 <= before < TRIALS
    assert flaws(url) == []
    capsys.readouterr()
    assert launched_here(url) == 0
    assert f"{before} of {TRIALS} already done" in capsys.readouterr().out
    assert flaws(url) == []
    assert done(url) == TRIALS
    assert numbers(url) == numbers(undisturbed)


def test_what_was_stored_is_read_back_as_the_trial_that_it_was(
    undisturbed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also the network's arguments, the digest of its file and the path."""
    with Reader.open(undisturbed) as reader:
        configs = reader.configs()
    assert {config.config["path"] for config in configs} == {"reference"}
    assert {config.config["model"]["width"] for config in configs} == {16}
    monkeypatch.syspath_prepend(str(EXAMPLE))
    for config in configs:
        mapping = without_versions(config.config)
        assert TrialSpec.from_mapping({**mapping, "seed": 0}).config_key == config.config_key
