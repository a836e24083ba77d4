"""Journal of an explorer: all that it was told is there before it answers, and is replayed."""

from __future__ import annotations

import io
import json
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt import Explorer
from dopt.errors import ExplorationError, SpecificationError
from dopt.explorer.journal import FORMAT, Journal
from dopt.systems import Pendulum
from tests.dopt.explorer.plants import MOTOR, following
from tests.dopt.explorer.saves import without_checksums
from tests.dopt.explorer.test_explorer import explored
from tests.paths import ROOT


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "motor.jsonl"


SHORT = {"name": "icem", "lookahead": 8, "hold": 4, "stride": 4, "plans": 12}

PARTS: dict[str, Any] = {"policy": SHORT, "learner": "gauss_newton"}
"""A policy that remembers its last plan, and a learner that keeps all samples."""

ABOUT: dict[str, Any] = {"format": 1, "trial": {}}


def test_a_reopened_exploration_goes_on_as_an_undisturbed_one(journal: Path) -> None:
    with Explorer(MOTOR, steps=40, **PARTS) as undisturbed:
        explored(undisturbed, 40)
    with Explorer(MOTOR, steps=40, journal=journal, **PARTS) as first:
        x = explored(first, 15)
        first.tell([np.nan, 0.0])
        first.tell(x)  # from which it goes on
        counts, parameters = first.counts, first.parameters
    with Explorer(MOTOR, steps=40, journal=journal, **PARTS) as second:
        assert second.counts == counts
        assert np.array_equal(second.parameters, parameters)
        explored(second, 25, x)
        assert np.array_equal(second.parameters, undisturbed.parameters)
        assert np.array_equal(second.inputs, undisturbed.inputs)


def test_the_name_of_a_new_journal_is_on_the_disk(
    journal: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    fsync = os.fsync

    def noted(descriptor: int) -> None:
        synced.append(str(Path(f"/proc/self/fd/{descriptor}").readlink()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", noted)
    Journal(journal, True, ABOUT).close()
    assert {str(journal.parent), str(journal.parent.parent)} <= set(synced)
    synced.clear()
    Journal(journal, True, ABOUT).close()
    assert synced == [str(journal)]  # as it is closed


def test_an_answer_survives_that_was_not_followed_by_a_state(journal: Path) -> None:
    with Explorer(MOTOR, steps=9, journal=journal, **PARTS) as first:
        x = explored(first, 5)
        u = first.ask(x)
    with Explorer(MOTOR, steps=9, journal=journal, **PARTS) as second:
        assert np.array_equal(second.ask(x), u)
        assert second.tell(following(x, u))


KILLED = """
import sys, numpy as np
from dopt import Explorer
from tests.dopt.explorer.plants import MOTOR, following
explorer = Explorer(MOTOR, steps=10_000, journal=sys.argv[1], fsync=False)
x = np.array([0.1, 0.0])
while True:
    u = explorer.ask(x)
    x = following(x, u)
    explorer.tell(x)
    print(explorer.n_steps, explorer.parameters.tobytes().hex(), flush=True)
"""


def test_a_killed_process_has_lost_nothing_that_was_told(journal: Path) -> None:
    command = [sys.executable, "-c", KILLED, journal]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("40 "):
                process.send_signal(signal.SIGKILL)
                break
        told = [line, *(rest for rest in process.stdout if rest.endswith("\n"))][-1].split()
    with Explorer(MOTOR, steps=10_000, journal=journal) as explorer:
        n, digits = int(told[0]), told[1]
        assert explorer.n_steps in (n, n + 1)  # one may have been written and not been printed
        replayed = explorer.states, explorer.inputs
    again = Explorer(MOTOR, steps=10_000)
    for x, u, x_next in zip(replayed[0], replayed[1][:n], replayed[0][1:], strict=False):
        again.ask(x)
        again.tell(x_next, applied=u)
    assert again.parameters.tobytes().hex() == digits


@pytest.mark.parametrize("cut", [1, 7])
def test_a_torn_line_is_dropped(journal: Path, cut: int) -> None:
    with Explorer(MOTOR, steps=9, journal=journal) as explorer:
        x = explored(explorer, 4)
        explorer.ask(x)
    os.truncate(journal, journal.stat().st_size - cut)
    with Explorer(MOTOR, steps=9, journal=journal) as explorer:
        assert explorer.n_steps == 4
        explored(explorer, 5, x)
    assert all(json.loads(line) for line in journal.read_text().splitlines())


def test_numbers_are_read_back_bit_for_bit(journal: Path) -> None:
    values = [np.nextafter(0.1, 1.0), 1e-310, -0.0, 2.0**53 + 1, np.pi]
    written = Journal(journal, True, ABOUT)
    written.write({"format": 1, "trial": {}, "values": values}, durable=True)
    written.close()
    reopened = Journal(journal, True, ABOUT)
    read = reopened.events[0]["values"]
    reopened.close()
    assert np.array(read).tobytes() == np.array(values).tobytes()


def test_two_processes_do_not_write_one_journal(journal: Path) -> None:
    with (
        Explorer(MOTOR, steps=5, journal=journal),
        pytest.raises(SpecificationError, match="another process"),
    ):
        Explorer(MOTOR, steps=5, journal=journal)


def test_the_journal_of_another_exploration_is_refused(journal: Path) -> None:
    Explorer(MOTOR, steps=5, journal=journal).close()
    with pytest.raises(SpecificationError, match=r"seed was 0 and is 1.*another file"):
        Explorer(MOTOR, steps=5, journal=journal, seed=1)
    with pytest.raises(SpecificationError, match=r"policy\.name was 'd_optimal' and is 'random'"):
        Explorer(MOTOR, steps=5, journal=journal, policy="random")
    Explorer(MOTOR, steps=5, journal=journal).close()  # which is not locked by the refused one


def test_a_journal_from_before_a_field_was_added_goes_on(journal: Path) -> None:
    system = Pendulum(horizon=5)
    Explorer(system, journal=journal).close()
    text = without_checksums(journal)
    assert '"integrator": "euler", ' in text
    journal.write_text(text.replace('"integrator": "euler", ', ""))
    Explorer(system, journal=journal).close()


@pytest.mark.parametrize(
    "content",
    ["no journal\n", "[1]\n", '{"format": 0}\n', '{"format": 1}\n', '{"my": "results of a year"}'],
)
def test_another_file_is_refused_and_left_as_it_is(journal: Path, content: str) -> None:
    journal.parent.mkdir()
    journal.write_text(content)
    with pytest.raises(SpecificationError, match=r"motor\.jsonl is no journal"):
        Explorer(MOTOR, steps=5, journal=journal)
    assert journal.read_text() == content


def test_a_beginning_that_is_torn_is_begun_again(journal: Path) -> None:
    Explorer(MOTOR, steps=5, journal=journal).close()
    os.truncate(journal, 12)
    Explorer(MOTOR, steps=5, journal=journal).close()
    assert json.loads(journal.read_text())["format"] == FORMAT


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SpecificationError, match="cannot be written"):
        Explorer(MOTOR, steps=5, journal=tmp_path)


class Full(io.FileIO):
    """A file on a disk that has room for half a line."""

    def write(self, data: Any) -> int:
        return super().write(bytes(data)[: len(data) // 2])


def test_a_full_disk_ends_the_exploration(journal: Path) -> None:
    explorer = Explorer(MOTOR, steps=9, journal=journal)
    x = explored(explorer, 3)
    explorer.ask(x)
    written = explorer._journal
    assert written is not None
    usual, written._file = written._file, Full(journal, "ab")
    with pytest.raises(ExplorationError, match=r"disk is full.*free space"):
        explorer.tell(x)
    written._file.close()
    written._file = usual  # there is room again, but the explorer is behind its journal
    with pytest.raises(ExplorationError, match="open the exploration again"):
        explorer.tell(x)
    assert explorer.n_steps == 3
    explorer.close()
    with Explorer(MOTOR, steps=9, journal=journal) as again:
        assert again.n_steps == 3


def test_what_is_told_is_on_the_disk_before_the_call_returns(
    journal: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_size))
    with Explorer(MOTOR, steps=9, journal=journal, fsync=True) as explorer:
        x = explored(explorer, 2)
        assert synced[-1] == journal.stat().st_size
        explorer.ask(x)
    count = len(synced)
    with Explorer(MOTOR, steps=9, journal=journal, fsync=False) as explorer:
        explored(explorer, 2, x)
        assert len(synced) == count


def test_a_fork_does_not_write_into_the_journal(journal: Path) -> None:
    explorer = Explorer(MOTOR, steps=9, journal=journal)
    x = explored(explorer, 2)
    assert explorer._journal is not None
    explorer._journal._process += 1  # what a fork finds
    with pytest.raises(ExplorationError, match="another process"):
        explorer.ask(x)
    explorer.close()


def test_a_journal_from_elsewhere_is_replayed_with_a_warning(
    journal: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Another processor rounds differently; the exploration goes on with what it was told."""
    with Explorer(MOTOR, steps=9, journal=journal) as explorer:
        explored(explorer, 4)
    lines = [json.loads(line) for line in without_checksums(journal).splitlines()]
    for event in lines:
        if "plan" in event:
            event["plan"] = [event["plan"][0] * (1 + 1e-15)]
    journal.write_text("".join(f"{json.dumps(event)}\n" for event in lines))
    with caplog.at_level(logging.WARNING), Explorer(MOTOR, steps=9, journal=journal) as explorer:
        assert explorer.n_steps == 4
    assert len([r for r in caplog.records if "another version or processor" in r.message]) == 1


def test_a_file_that_cannot_be_read_is_refused_and_freed(
    journal: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "read_bytes", refuse)
        with pytest.raises(SpecificationError, match="cannot be written or read"):
            Explorer(MOTOR, steps=5, journal=journal)
    Explorer(MOTOR, steps=5, journal=journal).close()
