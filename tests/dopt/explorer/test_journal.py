"""Journal of an explorer: written before it answers, replayed, refused where damaged."""

from __future__ import annotations

import dataclasses
import gc
import io
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt import Explorer, Plant
from dopt.errors import ExplorationError, SpecificationError
from dopt.explorer.journal import FORMAT, Journal
from dopt.spec.trial import stored_trial
from dopt.types import Array
from tests.dopt.explorer.plants import (
    HOVERCRAFT,
    MOTOR,
    drive,
    following,
    steered,
    without_checksums,
)
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "motor.jsonl"


def opened(journal: Path, steps: int = 9, **more: Any) -> Explorer:
    return Explorer(MOTOR, steps=steps, journal=journal, **more)


def driven(journal: Path, steps: int) -> Array:
    """Explore some steps and close the journal; return the last state."""
    with opened(journal) as explorer:
        return drive(explorer, steps)


ABOUT: dict[str, Any] = {"format": 1, "trial": {}}


def test_the_name_of_a_journal_is_on_the_disk(
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
    with opened(journal) as explorer:
        x = drive(explorer, 4)
        explorer.ask(x)
    os.truncate(journal, journal.stat().st_size - cut)
    with opened(journal) as explorer:
        assert explorer.n_steps == 4
        drive(explorer, 5, x)
    assert all(json.loads(line) for line in journal.read_text().splitlines())


def test_two_processes_do_not_write_one_journal(journal: Path) -> None:
    with opened(journal), pytest.raises(SpecificationError, match="another process"):
        opened(journal)


def test_the_journal_of_another_exploration_is_refused(journal: Path) -> None:
    opened(journal).close()
    with pytest.raises(SpecificationError, match=r"seed was 0 and is 1.*another file"):
        opened(journal, seed=1)
    with pytest.raises(SpecificationError, match=r"policy\.name was 'd_optimal' and is 'random'"):
        opened(journal, policy="random")
    opened(journal).close()  # which is not locked by the refused one


def test_a_journal_from_before_there_were_scales_goes_on_in_units(journal: Path) -> None:
    """It was written by the version before; what it had learned was read there."""
    journal.parent.mkdir()
    shutil.copy(Path(__file__).with_name("unscaled.jsonl"), journal)
    given: dict[str, Any] = {"steps": 20, "journal": journal, "learner": "gauss_newton"}
    with Explorer(MOTOR, **given) as explorer:
        predicted = explorer.predict([[0.3, 1.0], [-2.0, 4.0]])[:, 0]
        assert predicted == pytest.approx([-2.633545126124428, 3.2165734743615775], rel=1e-9)
        errors = [0.9610287238574211, 0.3579677133112369]
        assert explorer.errors[[0, 7]] == pytest.approx(errors, rel=1e-9)
        before = "fe24e8c0690435ed84ff0e449e019588c6caa623b6856db59eb6b06f54bfc075"
        assert explorer.spec.trial_key == before
        drive(explorer, 5, explorer.states[-1])
        parameters = explorer.parameters
    with Explorer(MOTOR, **given) as again:
        assert np.array_equal(again.parameters, parameters)
        assert again.n_steps == 13


def test_a_new_journal_says_that_its_exploration_is_scaled(journal: Path) -> None:
    with opened(journal) as explorer:
        drive(explorer, 4)
        parameters, key = explorer.parameters, explorer.spec.trial_key
    assert json.loads(journal.read_text().splitlines()[0])["trial"]["env"]["scaled"] is True
    with opened(journal) as again:
        assert np.array_equal(again.parameters, parameters)
    assert stored_trial(json.loads(explorer.spec.config_json)).trial_key == key


NO_JOURNAL = r"motor\.jsonl is no journal"
NO_TRIAL = r"no exploration|another exploration"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        *((text, NO_JOURNAL) for text in ("no journal\n", "[1]\n", '{"format": 0}\n')),
        *((text, NO_JOURNAL) for text in ('{"format": 1}\n', '{"my": "results of a year"}')),
        *(
            (f"{json.dumps({'format': 1, 'trial': trial})}\n", NO_TRIAL)
            for trial in (5, None, [], {}, {"policy": 5})
        ),
    ],
)
def test_another_file_is_refused_and_left_as_it_is(journal: Path, content: str, said: str) -> None:
    journal.parent.mkdir()
    journal.write_text(content)
    with pytest.raises(SpecificationError, match=said):
        opened(journal)
    assert journal.read_text() == content


@pytest.mark.parametrize("end", [b"", b" ", b"}"])
def test_a_journal_without_newlines_is_kept(journal: Path, end: bytes) -> None:
    driven(journal, 0 if end else 3)
    whole = journal.read_bytes().replace(b"\n", b"") + end
    journal.write_bytes(whole)
    with pytest.raises(SpecificationError, match=r"format 1 or 2 \(it has no whole line"):
        opened(journal)
    assert journal.read_bytes() == whole


def test_a_beginning_that_is_torn_is_begun_again(journal: Path) -> None:
    opened(journal).close()
    os.truncate(journal, 12)
    opened(journal).close()
    assert json.loads(journal.read_text())["format"] == FORMAT


def test_what_cannot_be_read_is_refused(journal: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "read_bytes", refuse)
        with pytest.raises(SpecificationError, match="cannot be written or read"):
            opened(journal)
    opened(journal).close()
    with pytest.raises(SpecificationError, match="cannot be written"):
        opened(journal.parent)


class Full(io.FileIO):
    """A file on a disk that has room for half a line."""

    def write(self, data: Any) -> int:
        return super().write(bytes(data)[: len(data) // 2])


def test_a_full_disk_ends_the_exploration(journal: Path) -> None:
    explorer = opened(journal)
    x = drive(explorer, 3)
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
    with opened(journal) as again:
        assert again.n_steps == 3


def test_what_is_told_is_on_the_disk_at_once(
    journal: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_size))
    with opened(journal, fsync=True) as explorer:
        x = drive(explorer, 2)
        assert synced[-1] == journal.stat().st_size
        explorer.ask(x)
    count = len(synced)
    with opened(journal, fsync=False) as explorer:
        drive(explorer, 2, x)
        assert len(synced) == count


def test_a_fork_does_not_write_into_the_journal(journal: Path) -> None:
    with opened(journal) as explorer:
        x = drive(explorer, 2)
        assert explorer._journal is not None
        explorer._journal._process += 1  # what a fork finds
        with pytest.raises(ExplorationError, match="another process"):
            explorer.ask(x)


def test_a_journal_from_elsewhere_is_replayed(
    journal: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Another processor rounds differently; the exploration goes on with what it was told."""
    driven(journal, 4)
    lines = [json.loads(line) for line in without_checksums(journal).splitlines()]
    for event in lines:
        if "plan" in event:
            event["plan"] = [event["plan"][0] * (1 + 1e-15)]
    journal.write_text("".join(f"{json.dumps(event)}\n" for event in lines))
    with caplog.at_level(logging.WARNING), opened(journal) as explorer:
        assert explorer.n_steps == 4
    assert len([r for r in caplog.records if "another version or processor" in r.message]) == 1


@pytest.mark.parametrize("replaced", [False, True])
@pytest.mark.parametrize("fsync", [False, True])
def test_a_journal_that_is_removed_is_said(journal: Path, fsync: bool, replaced: bool) -> None:
    with opened(journal, fsync=fsync) as explorer:
        x = drive(explorer, 3)
        u = explorer.ask(x)
        journal.unlink()
        if replaced:
            journal.touch()
        with pytest.raises(ExplorationError, match=r"was removed or replaced .* another journal"):
            explorer.tell(following(x, u))
        assert explorer.n_steps == 3


def test_a_renamed_journal_holds_what_follows(journal: Path, tmp_path: Path) -> None:
    with opened(journal) as explorer:
        x = drive(explorer, 3)
        journal.rename(tmp_path / "renamed.jsonl")
        drive(explorer, 2, x)
    with opened(tmp_path / "renamed.jsonl") as again:
        assert again.n_steps == 5


LEARN = {"learn": [0.1, 0.0], "applied": [1.0], "dt": 0.02, "time": None}

DAMAGED: list[object] = [
    {"foo": 1},
    {**LEARN, "learn": [1.0]},
    {**LEARN, "learn": [1.0, 2.0, 3.0]},
    {**LEARN, "learn": "ab"},
    {**LEARN, "learn": [float("nan"), 0.0]},
    {**LEARN, "applied": [1.0, 2.0]},
    {**LEARN, "dt": "x"},
    {**LEARN, "dt": 0.0},
    {**LEARN, "time": [1]},
    {"learn": [0.1, 0.0]},
    {"lost": ["x"]},
    {"lost": "x"},
    {"counted": {}},
    {"plan": 3},
    {"missed": None},
    {"begin": [0.1, 0.0]},
    {"gap": [0.1, True], "time": "1"},
    {"begin": [10**400, 0], "time": None},
]


@pytest.mark.parametrize("event", DAMAGED)
def test_a_line_that_is_no_event_is_refused_with_its_number(journal: Path, event: Any) -> None:
    driven(journal, 1)
    lines = without_checksums(journal).splitlines(keepends=True)
    lines.insert(3, f"{json.dumps(event)}\n")
    journal.write_text("".join(lines))
    with pytest.raises(SpecificationError, match=r"format 1 or 2 \(line 4 is no event"):
        opened(journal)
    assert journal.read_text() == "".join(lines)


def test_events_that_cannot_follow_are_refused(journal: Path) -> None:
    """A step without a state before it, and one for which there is no room."""
    driven(journal, 2)
    whole = without_checksums(journal).splitlines(keepends=True)
    journal.write_text("".join([whole[0], *whole[2:]]))
    with pytest.raises(SpecificationError, match="line 2 is no event that can follow"):
        opened(journal)
    journal.write_text("".join([*whole, *7 * [f"{json.dumps(LEARN)}\n"]]))
    opened(journal).close()
    journal.write_text("".join([*whole, *8 * [f"{json.dumps(LEARN)}\n"]]))
    with pytest.raises(SpecificationError, match="line 14 is no event that can follow"):
        opened(journal)


@pytest.fixture
def lines(journal: Path) -> list[bytes]:
    """Return the lines of a journal with some events of each kind."""
    with opened(journal) as explorer:
        x = drive(explorer, 2)
        explorer.tell([np.nan, 0.0])
        explorer.reset()
        drive(explorer, 2, x)
    return journal.read_bytes().splitlines(keepends=True)


def answer(journal: Path, content: bytes) -> str:
    """Return what is said of a journal that is opened, or refused and left as it is."""
    journal.write_bytes(content)
    try:
        opened(journal).close()
    except SpecificationError as error:
        assert journal.read_bytes() == content
        return str(error)
    return "opened"


def test_each_bit_of_a_journal_is_checked(journal: Path, lines: list[bytes]) -> None:
    """A flip that takes the last newline away leaves a torn line, which is dropped as ever."""
    content = b"".join(lines)
    ends = np.cumsum([len(line) for line in lines])
    for bit in range(0, 8 * (len(content) - 1), 7):  # one bit of a byte, the next of the next
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        number = int(np.searchsorted(ends, bit // 8, side="right")) + 1
        journal.write_bytes(flipped)
        with pytest.raises(SpecificationError, match=rf"line {number}\b|first line"):
            Journal(journal, False, {"format": FORMAT, "trial": {}})


def test_removed_repeated_swapped_or_added_lines_are_refused(
    journal: Path, lines: list[bytes]
) -> None:
    for i in range(1, len(lines) - 1):
        removed = i + 1, [*lines[:i], *lines[i + 1 :]]
        repeated = i + 2, [*lines[: i + 1], *lines[i:]]
        swapped = i + 1, [*lines[:i], lines[i + 1], lines[i], *lines[i + 2 :]]
        for number, content in (removed, repeated, swapped):
            assert f"line {number} of the journal" in answer(journal, b"".join(content))
    added = json.dumps(LEARN).encode() + b"\n"
    assert "head -n 4 " in answer(journal, b"".join([*lines[:4], added, *lines[4:]]))
    assert "head -n" in answer(journal, b"".join([*lines, added]))
    assert answer(journal, b"".join(lines[:-1])) == "opened"


def test_a_line_of_brackets_is_refused_in_a_sentence(journal: Path, lines: list[bytes]) -> None:
    deep, first = b"[" * 100_000, without_checksums(journal).split("\n")[0].encode()
    assert "no journal" in answer(journal, deep + b"\n")
    assert "line 2 of the journal" in answer(journal, lines[0] + deep + b"\n")
    nested = b'{"plan": %s1%s}' % (b"[" * 900, b"]" * 900)
    for event in (deep, nested, b'{"plan": [1%s]}' % (b"0" * 5000)):
        assert "(line 2" in answer(journal, b"%s\n%s\n" % (first, event))


def test_a_journal_of_format_1_goes_on_with_checksums(journal: Path, lines: list[bytes]) -> None:
    old = without_checksums(journal)
    journal.write_text(old)
    with opened(journal) as explorer:
        drive(explorer, 2)
    content = journal.read_bytes()
    assert content.startswith(old.encode())
    assert answer(journal, content) == "opened"
    number = len(lines) + 1  # the first one with a checksum, of all before it
    assert f"line {number} of" in answer(journal, content.replace(b'"resets"', b'"unusable"'))


REPLAY_SHORT = {"name": "icem", "lookahead": 6, "hold": 3, "stride": 3, "plans": 8, "elites": 3}

SETTINGS: dict[str, Any] = {
    "policy": REPLAY_SHORT,
    "learner": "gauss_newton",
    "steps": 80,
    "deadline": PATIENCE_SECONDS,
    "fallback": [0.25, -0.25],
}


LATE = dataclasses.replace(HOVERCRAFT, delay=1.5 * HOVERCRAFT.dt, lag=0.02, supply=3.0)
"""The same plant behind hardware, whose inputs in flight are a part of the exploration too."""


def replayed(journal: Path, plant: Plant = HOVERCRAFT) -> Explorer:
    return Explorer(plant, journal=journal, fsync=False, **SETTINGS)


def condition(explorer: Explorer) -> list[Any]:
    """Return all by which an exploration goes on."""
    state = explorer._state
    arrays = explorer.parameters, explorer.inputs, explorer.errors, state.answer, state.present
    numbers = (None if values is None else values.tobytes() for values in arrays)
    return [explorer.n_steps, explorer.counts, state.time, *numbers]


@contextmanager
def slow_plans(explorer: Explorer) -> Iterator[None]:
    """Let no plan be ready in time until the end."""
    may_end, plan = threading.Event(), explorer._state.plan
    planner: Any = explorer._planner
    before = planner._make, planner._deadline

    def slow() -> None:
        may_end.wait(PATIENCE_SECONDS)
        plan()

    planner._make, planner._deadline = slow, 0.001
    try:
        yield
    finally:
        may_end.set()
        planner._make, planner._deadline = before


class Rig:
    """The hovercraft with its clock, and an explorer that meets all kinds of calls."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.x, self.now, self.u = np.array([0.1, 0.2, 0.0]), 0.0, np.zeros(2)

    def call(self, explorer: Explorer) -> None:
        """Make one drawn call."""
        kinds = ["ask", "late", "tell", "tell", "tell", "again", "old", "nan", "gap", "reset"]
        kind = self.rng.choice(kinds, p=[0.3, 0.08, 0.15, 0.15, 0.1, 0.06, 0.05, 0.04, 0.04, 0.03])
        match kind:
            case "ask":
                self.u = explorer.ask(self.x, time=self.now)
            case "late":
                with slow_plans(explorer):
                    self.u = explorer.ask(self.x, time=self.now)
            case "tell":
                self._move(HOVERCRAFT.dt * self.rng.uniform(0.8, 1.2))
                explorer.tell(self.x, applied=self.u, time=self.now)
            case "again":
                explorer.tell(self.x, applied=self.u, time=self.now)
            case "old":
                explorer.tell(self.x + 0.1, applied=self.u, time=self.now - 0.03)
            case "nan":
                self._move(HOVERCRAFT.dt)
                explorer.tell(self.x * np.nan, applied=self.u, time=self.now)
            case "gap":
                self._move(3.0 * HOVERCRAFT.dt)
                explorer.tell(self.x, applied=self.u, time=self.now)
            case "reset":
                explorer.reset()

    def _move(self, dt: float) -> None:
        self.x, self.now = steered(self.x, self.u, dt), self.now + dt


@pytest.mark.parametrize("seed", range(4))
def test_it_goes_on_as_if_it_had_not_been_closed(seed: int, tmp_path: Path) -> None:
    plant = LATE if seed % 2 else HOVERCRAFT
    whole, cut = (replayed(tmp_path / f"{name}.jsonl", plant) for name in ("whole", "cut"))
    one, other = Rig(seed), Rig(seed)
    closings = np.random.default_rng(100 + seed)
    for _ in range(60):
        one.call(whole)
        other.call(cut)
        assert condition(cut) == condition(whole)
        if closings.random() < 0.2:
            cut.close()
            cut = replayed(tmp_path / "cut.jsonl", plant)
            whole._wait()  # as closing does: a late plan ends before
            assert condition(cut) == condition(whole)
    assert np.array_equal(cut.ask(one.x, time=one.now), whole.ask(one.x, time=one.now))
    whole.close()
    cut.close()


def test_ctrl_c_waits_until_a_call_is_whole(tmp_path: Path) -> None:
    """It comes while the event is written: the event is also done, once, and then it is raised."""
    explorer = replayed(tmp_path / "run.jsonl")
    x = np.array([0.1, 0.2, 0.0])
    u = explorer.ask(x)
    journal: Any = explorer._journal
    write = journal.write

    def interrupted(event: Any, *, durable: bool) -> None:
        write(event, durable=durable)
        os.kill(os.getpid(), signal.SIGINT)

    journal.write = interrupted
    with pytest.raises(KeyboardInterrupt):
        explorer.tell(steered(x, u))
    journal.write = write
    before = condition(explorer)
    assert before[0] == 1
    explorer.close()
    explorer.close()
    with pytest.raises(ExplorationError, match="is closed"):
        explorer.ask(x)
    with replayed(tmp_path / "run.jsonl") as again:
        assert condition(again) == before


def test_a_question_during_a_late_plan_does_not_wait() -> None:
    with Explorer(HOVERCRAFT, **SETTINGS) as explorer:
        x = np.array([0.1, 0.2, 0.0])
        explorer.tell(x := steered(x, explorer.ask(x)))
        with slow_plans(explorer):
            for _ in range(2):
                assert np.array_equal(explorer.ask(x), [0.25, -0.25])
                assert not explorer._planner._late.done()
        assert explorer.tell(steered(x, np.array([0.25, -0.25])))
        assert explorer.counts["missed"] == 1
        assert explorer.inputs[1].tolist() == [0.25, -0.25]


@pytest.mark.parametrize("held", [False, True])
def test_an_explorer_that_is_forgotten_frees_its_journal(journal: Path, held: bool) -> None:
    """As a cell of a notebook that is run twice leaves one behind.

    Frames of exceptions that nobody sees may hold it, as of Numba when it has compiled the plant.
    """

    def run_twice() -> None:
        explorer = Explorer(HOVERCRAFT, steps=5, journal=journal)
        if held:
            explorer.held = explorer  # type: ignore[attr-defined]
        del explorer
        Explorer(HOVERCRAFT, steps=5, journal=journal).close()

    gc.disable()
    try:
        with pytest.warns(ResourceWarning):
            run_twice()
    finally:
        gc.enable()
