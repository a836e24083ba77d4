"""Append-only file of an exploration: its specification, and everything that changed its state.

Each line is one event (:mod:`dopt.explorer.state`) as JSON. It is in the file before the
exploration goes on, and a durable one is on the disk where ``fsync`` is set; a line that a power
cut has torn is dropped when the file is opened again, the first one only where it is the beginning
of the one that would be written. Real numbers are written so that they are read back bit for bit.

The entry ``sum`` at the end of a line is the CRC-32 of all bytes of the file before it, so that no
line can be changed, removed, added or moved without notice. Journals of format 1 have none before
the line with which a program that writes them has gone on.
"""

from __future__ import annotations

import gc
import json
import math
import os
import re
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from dopt.arguments import finite, seconds, whole, within
from dopt.errors import ExplorationError, SpecificationError, given_path
from dopt.process import lock_file

FORMAT = 2
"""Version of the lines."""

_SUMMED = re.compile(rb'(.*), "sum": "([0-9a-f]{8})"}\n', re.DOTALL)

Event = Mapping[str, Any]


class Journal:
    """A journal that one process writes, through one object.

    Parameters
    ----------
    path : str or Path
        File, which is made if it is not there.
    fsync : bool
        Whether a durable event is on the disk before :meth:`write` returns.
    about : mapping
        First line, with the specification, which :meth:`write` has to begin with.

    Attributes
    ----------
    path : Path
    events : list of mappings
        Events in the file when it was opened, the first with a specification.

    Raises
    ------
    SpecificationError
        If the file cannot be opened, is being written, or is not a journal.
    """

    def __init__(self, path: str | Path, fsync: bool, about: Event) -> None:
        self.path, self._fsync, self._about = given_path(path, "journal"), fsync, about
        self._process, self._broken = os.getpid(), False
        try:
            self._open()
        except OSError as error:
            raise SpecificationError(
                f"the journal {path} cannot be written or read ({error}): give a file in a folder "
                f"that can be."
            ) from error

    def _open(self) -> None:
        """Open the file, or leave it closed and unlocked with an error."""
        new = [path for path in (self.path, *self.path.parents) if not path.exists()]
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("ab", buffering=0)
        try:
            _lock(self._file.fileno(), self.path)
            self._size, self._sum, self.events = _read(self.path, _line(self._about, 0))
            self._file.truncate(self._size)
            if self._fsync:
                for path in new:
                    _sync_folder(path.parent)
        except BaseException:
            self._file.close()
            raise

    def lacks(self, section: str, field: str) -> bool:
        """Return True if it holds an exploration that was begun before there was such a field."""
        stored = self.events[0]["trial"].get(section) if self.events else {field: True}
        return not (isinstance(stored, Mapping) and stored.get(field))

    def write(self, event: Event, *, durable: bool) -> None:
        """Append an event; one that is not durable may wait for the next one that is.

        Raises
        ------
        ExplorationError
            If the disk is full or broken, now or before; if the journal is closed, another process
            has opened it, or its file was removed.
        """
        if self._file.closed or self._broken or os.getpid() != self._process:
            raise ExplorationError(
                f"the journal {self.path} is closed, or belongs to another process: open the "
                f"exploration again."
            )
        if durable and os.fstat(self._file.fileno()).st_nlink == 0:
            raise ExplorationError(
                f"the journal {self.path} was removed or replaced since it was opened, so that "
                f"nothing more is kept: save() what was explored, and begin again with another "
                f"journal."
            )
        line = _line(event, self._sum)
        try:
            if self._file.write(line) != len(line):
                raise OSError("the disk is full")
            if durable and self._fsync:
                os.fsync(self._file.fileno())
        except OSError as error:
            self._broken = True
            with suppress(OSError):
                self._file.truncate(self._size)  # half a line would hide what follows it
            raise ExplorationError(
                f"the journal {self.path} could not be written ({error}), so that the exploration "
                f"cannot go on: free space on its disk, and open the exploration again."
            ) from error
        self._size, self._sum = self._size + len(line), zlib.crc32(line, self._sum)

    def close(self) -> None:
        """Close the file, on the disk."""
        if not self._file.closed:
            with suppress(OSError):
                os.fsync(self._file.fileno())
            self._file.close()


def _line(event: Event, before: int) -> bytes:
    """Return the line of an event after lines with a checksum."""
    line = json.dumps(event, allow_nan=False).encode()[:-1]
    return b'%s, "sum": "%08x"}\n' % (line, zlib.crc32(line, before))


def _sync_folder(folder: Path) -> None:
    """Put the names of the files in a folder on the disk: a new file is lost without its name."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _lock(file: int, path: Path) -> None:
    """Lock a file that no explorer writes, also if one has it open that was forgotten.

    Exceptions that Numba has caught while it compiled refer to themselves, and through their frames
    to the explorer for which it did: without the collector of garbage it may stay for long.
    """
    if not lock_file(file, wait=False):
        gc.collect()
        if not lock_file(file, wait=False):
            raise SpecificationError(
                f"the journal {path} is written by another explorer, here or in another process, "
                f"but one at a time may do so: close() it, or give another file."
            )


def _read(path: Path, beginning: bytes) -> tuple[int, int, list[dict[str, Any]]]:
    """Return the number of bytes that are whole lines, their checksum and their events.

    A first line that is not whole has to be part of the beginning.
    """
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    torn = content[whole:]
    if whole == 0 and not beginning.startswith(torn):
        raise foreign(path, f"it has no whole line, and begins with {torn[:20]!r}")
    events: list[dict[str, Any]] = []
    before, summed = 0, False
    for number, line in enumerate(content[:whole].splitlines(keepends=True), start=1):
        found = _SUMMED.fullmatch(line)
        if int(found[2], 16) != zlib.crc32(found[1], before) if found else summed:
            raise _damaged(path, number)
        event = _event(path, number, line)
        if not found and event.get("format") == FORMAT:
            raise _damaged(path, number)
        events.append(event)
        before, summed = zlib.crc32(line, before), bool(found)
    if events and (
        events[0].get("format") not in (1, FORMAT) or not isinstance(events[0].get("trial"), dict)
    ):
        raise foreign(path, "its first line describes no exploration")
    return whole, before, events


def _event(path: Path, number: int, line: bytes) -> dict[str, Any]:
    try:
        event = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise foreign(path, f"line {number}: {error}") from error
    if not isinstance(event, dict):
        raise foreign(path, f"line {number} is no JSON object")
    event.pop("sum", None)
    return event


def _damaged(path: Path, number: int) -> SpecificationError:
    kept = f", or the lines before it alone (head -n {number - 1} {path} > OTHER)"
    return SpecificationError(
        f"line {number} of the journal {path} does not have the checksum of what is before it, so "
        f"that it, or a line before it, was changed, removed, added or moved: give a copy from "
        f"before that{kept if number > 1 else ''}."
    )


def foreign(path: Path, reason: str) -> SpecificationError:
    """Return the error for a file that is not a journal."""
    return SpecificationError(
        f"{path} is no journal of format 1 or {FORMAT} ({reason}), but one was expected there: "
        f"give the path of a journal, or of a file that does not exist."
    )


# Events that a journal may hold: their entries, and the numbers in each.


_ENTRIES = {
    "learn": ("learn", "applied", "dt", "time"),
    "plan": ("plan",),
    "missed": ("missed",),
    "begin": ("begin", "time"),
    "gap": ("gap", "time"),
    "lost": ("lost",),
    "counted": ("counted",),
    "refit": ("refit", "fitted", "rows"),
    "renewed": ("renewed",),
}
_NAMES = {"lost": ("unusable", "resets"), "counted": ("repeated", "out_of_order")}
_INPUTS = ("applied", "plan", "missed")


def is_event(event: Event, n_states: int, n_inputs: int) -> bool:
    """Return True if an event has the entries of its kind, with finite numbers."""
    entries = next((entries for kind, entries in _ENTRIES.items() if kind in event), ())
    if not entries or not event.keys() >= set(entries):
        return False
    with suppress(SpecificationError):
        for entry in (*entries, *({"supply"} & event.keys())):
            if entry in _NAMES:
                return event[entry] in _NAMES[entry]
            if entry in ("dt", "supply"):
                within(entry, event[entry], math.inf)
            elif entry in ("rows", "renewed"):
                whole(entry, event[entry], 1)
            elif entry in ("refit", "fitted"):
                finite(entry, event[entry], np.size(event[entry]))
            elif entry == "time":
                seconds(event[entry])
            else:
                finite(entry, event[entry], n_inputs if entry in _INPUTS else n_states)
        return True
    return False
