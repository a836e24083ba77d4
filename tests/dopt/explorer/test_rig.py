"""The rig of the documentation: a motor in another process, over datagrams, killed at both ends."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from dopt import Explorer
from orchestrate.store import Reader
from tests.paths import EXAMPLE, ROOT
from tests.waiting import PATIENCE_SECONDS, until


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> object:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    import rig

    return rig


def started(*words: str) -> subprocess.Popen[str]:
    command = [sys.executable, EXAMPLE / "rig.py", *words]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def reopened(rig: object, journal: Path) -> Explorer:
    return Explorer(rig.MOTOR, steps=60_000, journal=journal)  # type: ignore[attr-defined]


def wait_for_steps(journal: Path, count: int, after: str = "") -> None:
    """Wait until the journal has so many learned steps after a text."""

    def are_there() -> bool:
        content = journal.read_text() if journal.exists() else ""
        return after in content and content[content.find(after) :].count('"learn"') >= count

    until(are_there, lambda: f"there are no {count} steps after '{after}'")


def test_either_end_is_killed_and_the_exploration_goes_on(rig: object, tmp_path: Path) -> None:
    journal = tmp_path / "rig.jsonl"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    motor = ["--role", "motor", "--port", port, "--loss", "0.05", "--jitter", "0.2"]
    explorer = ["--role", "explorer", "--port", port, "--journal", str(journal)]
    running = [started(*motor), started(*explorer, "--seconds", "600")]
    try:
        wait_for_steps(journal, 100)
        running[0].send_signal(signal.SIGKILL)
        running.append(started(*motor))
        wait_for_steps(journal, 101, after="resets")
        running[1].send_signal(signal.SIGKILL)
        running[1].communicate(timeout=PATIENCE_SECONDS)
        with reopened(rig, journal) as after:
            told, parameters = after.n_steps, after.parameters
        assert told > 200, after.counts
        assert after.counts["resets"] == 1
        assert after.counts["gaps"] > 0  # where datagrams were lost
        learned = journal.read_text().count('"learn"')
        running.append(started(*explorer, "--seconds", "600"))
        wait_for_steps(journal, learned + 1)
        running[-1].kill()
        said = running[-1].communicate(timeout=PATIENCE_SECONDS)[0]
        assert f"{told} steps in the journal" in said
    finally:
        for process in running:
            process.kill()
            process.communicate()
    with reopened(rig, journal) as again:
        assert again.n_steps > told
        assert not np.array_equal(again.parameters, parameters)
        assert np.isfinite(again.errors).all()


def test_it_is_saved_and_its_answers_are_drawn(rig: object, tmp_path: Path) -> None:
    url, picture = f"sqlite:///{tmp_path}/results.db", tmp_path / "answers.png"
    journal = ["--journal", str(tmp_path / "rig.jsonl")]
    process = started("--seconds", "3", *journal, "--save", url, "--histogram", str(picture))
    said = process.communicate(timeout=PATIENCE_SECONDS)[0]
    with reopened(rig, tmp_path / "rig.jsonl") as after, Reader.open(url) as reader:
        [config] = reader.configs()
        curves = reader.curves(config.config_key)
        assert np.array_equal(curves.values, [after.errors])
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "answers: " in said


def test_a_database_that_fails_does_not_end_it(tmp_path: Path) -> None:
    journal = ["--journal", str(tmp_path / "rig.jsonl")]
    process = started("--seconds", "1", *journal, "--save", "sqlite:////dev/null/results.db")
    said = process.communicate(timeout=PATIENCE_SECONDS)[0]
    assert process.returncode == 0
    assert "answers: " in said


def test_the_seconds_begin_with_the_first_state(rig: object) -> None:
    """A process that starts takes its time, and that of the exploration is not shortened by it."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as motor,
        Explorer(rig.MOTOR, steps=50) as explorer,  # type: ignore[attr-defined]
    ):
        wire.bind(("127.0.0.1", 0))
        state = rig.STATE.pack(1, 0.0, 0.0, 0.0, 0.0)  # type: ignore[attr-defined]
        late = threading.Timer(0.3, motor.sendto, (state, wire.getsockname()))
        late.start()
        assert len(rig.explore(wire, explorer, seconds=0.1)) == 1  # type: ignore[attr-defined]
        late.join()


def test_a_motor_that_never_comes_is_not_waited_for(
    rig: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig, "PATIENCE", 0.1)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire,
        Explorer(rig.MOTOR, steps=50) as explorer,  # type: ignore[attr-defined]
    ):
        wire.bind(("127.0.0.1", 0))
        assert len(rig.explore(wire, explorer, seconds=600.0)) == 0  # type: ignore[attr-defined]
