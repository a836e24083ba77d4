"""Journals that were damaged, removed or replaced: nothing is lost in silence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt import Explorer
from dopt.errors import ExplorationError, SpecificationError
from dopt.explorer.journal import FORMAT, Journal
from tests.dopt.explorer.plants import MOTOR, following
from tests.dopt.explorer.saves import without_checksums
from tests.dopt.explorer.test_explorer import explored


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    return tmp_path / "motor.jsonl"


@pytest.mark.parametrize("replaced", [False, True])
@pytest.mark.parametrize("fsync", [False, True])
def test_a_journal_that_is_removed_is_said(journal: Path, fsync: bool, replaced: bool) -> None:
    with Explorer(MOTOR, steps=9, journal=journal, fsync=fsync) as explorer:
        x = explored(explorer, 3)
        u = explorer.ask(x)
        journal.unlink()
        if replaced:
            journal.touch()
        with pytest.raises(ExplorationError, match=r"was removed or replaced .* another journal"):
            explorer.tell(following(x, u))
        assert explorer.n_steps == 3


def test_a_renamed_journal_holds_what_follows(journal: Path, tmp_path: Path) -> None:
    with Explorer(MOTOR, steps=9, journal=journal) as explorer:
        x = explored(explorer, 3)
        journal.rename(tmp_path / "renamed.jsonl")
        explored(explorer, 2, x)
    with Explorer(MOTOR, steps=9, journal=tmp_path / "renamed.jsonl") as again:
        assert again.n_steps == 5


@pytest.mark.parametrize("end", [b"", b" ", b"}"])
def test_a_journal_without_newlines_is_kept(journal: Path, end: bytes) -> None:
    with Explorer(MOTOR, steps=9, journal=journal) as explorer:
        explored(explorer, 0 if end else 3)
    whole = journal.read_bytes().replace(b"\n", b"") + end
    journal.write_bytes(whole)
    with pytest.raises(
        SpecificationError, match=r"no journal of format 1 or 2 \(it has no whole line"
    ):
        Explorer(MOTOR, steps=9, journal=journal)
    assert journal.read_bytes() == whole


def test_a_first_line_that_lacks_its_end_alone_is_begun_again(journal: Path) -> None:
    Explorer(MOTOR, steps=9, journal=journal).close()
    whole = journal.read_bytes()
    journal.write_bytes(whole[:-1])
    Explorer(MOTOR, steps=9, journal=journal).close()
    assert journal.read_bytes() == whole


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
    with Explorer(MOTOR, steps=9, journal=journal) as explorer:
        explored(explorer, 1)
    lines = without_checksums(journal).splitlines(keepends=True)
    lines.insert(3, f"{json.dumps(event)}\n")
    journal.write_text("".join(lines))
    with pytest.raises(
        SpecificationError, match=r"no journal of format 1 or 2 \(line 4 is no event"
    ):
        Explorer(MOTOR, steps=9, journal=journal)
    assert journal.read_text() == "".join(lines)


def test_a_journal_without_its_first_state_is_refused(journal: Path) -> None:
    with Explorer(MOTOR, steps=9, journal=journal) as explorer:
        explored(explorer, 1)
    first, _, *rest = without_checksums(journal).splitlines(keepends=True)
    journal.write_text("".join([first, *rest]))
    with pytest.raises(SpecificationError, match="line 2 is no event that can follow"):
        Explorer(MOTOR, steps=9, journal=journal)


def test_more_steps_than_there_are_are_refused(journal: Path) -> None:
    with Explorer(MOTOR, steps=2, journal=journal) as explorer:
        explored(explorer, 2)
    journal.write_text(f"{without_checksums(journal)}{json.dumps(LEARN)}\n")
    with pytest.raises(SpecificationError, match="line 7 is no event that can follow"):
        Explorer(MOTOR, steps=2, journal=journal)


@pytest.mark.parametrize("trial", [5, None, [], {}, {"policy": 5}])
def test_a_first_line_without_a_specification_is_refused(journal: Path, trial: object) -> None:
    journal.write_text(f"{json.dumps({'format': 1, 'trial': trial})}\n")
    with pytest.raises(SpecificationError, match=r"no exploration|another exploration"):
        Explorer(MOTOR, steps=2, journal=journal)


@pytest.fixture
def lines(journal: Path) -> list[bytes]:
    """Return the lines of a journal with some events of each kind."""
    with Explorer(MOTOR, steps=9, journal=journal) as explorer:
        x = explored(explorer, 2)
        explorer.tell([np.nan, 0.0])
        explorer.reset()
        explored(explorer, 2, x)
    return journal.read_bytes().splitlines(keepends=True)


def opened(journal: Path, content: bytes) -> str:
    """Return what is said of a journal that is opened, or refused and left as it is."""
    journal.write_bytes(content)
    try:
        with Explorer(MOTOR, steps=9, journal=journal):
            return "opened"
    except SpecificationError as error:
        assert journal.read_bytes() == content
        return str(error)


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


def test_a_line_that_is_removed_repeated_swapped_or_added_is_refused(
    journal: Path, lines: list[bytes]
) -> None:
    for i in range(1, len(lines) - 1):
        removed = i + 1, [*lines[:i], *lines[i + 1 :]]
        repeated = i + 2, [*lines[: i + 1], *lines[i:]]
        swapped = i + 1, [*lines[:i], lines[i + 1], lines[i], *lines[i + 2 :]]
        for number, content in (removed, repeated, swapped):
            assert f"line {number} of the journal" in opened(journal, b"".join(content))
    added = json.dumps(LEARN).encode() + b"\n"
    assert "head -n 4 " in opened(journal, b"".join([*lines[:4], added, *lines[4:]]))
    assert "head -n" in opened(journal, b"".join([*lines, added]))
    assert opened(journal, b"".join(lines[:-1])) == "opened"


def test_a_line_of_brackets_is_refused_in_a_sentence(journal: Path, lines: list[bytes]) -> None:
    deep, first = b"[" * 100_000, without_checksums(journal).split("\n")[0].encode()
    assert "no journal" in opened(journal, deep + b"\n")
    assert "line 2 of the journal" in opened(journal, lines[0] + deep + b"\n")
    nested = b'{"plan": %s1%s}' % (b"[" * 900, b"]" * 900)
    for event in (deep, nested, b'{"plan": [1%s]}' % (b"0" * 5000)):
        assert "(line 2" in opened(journal, b"%s\n%s\n" % (first, event))


def test_a_journal_of_format_1_goes_on_with_checksums(journal: Path, lines: list[bytes]) -> None:
    old = without_checksums(journal)
    journal.write_text(old)
    with Explorer(MOTOR, steps=9, journal=journal) as explorer:
        explored(explorer, 2)
    content = journal.read_bytes()
    assert content.startswith(old.encode())
    assert opened(journal, content) == "opened"
    number = len(lines) + 1  # the first one with a checksum, of all before it
    assert f"line {number} of" in opened(journal, content.replace(b'"resets"', b'"unusable"'))
