"""A grid of short trials in a database of its own, launched in a process that can be hurt."""

from __future__ import annotations

import dataclasses
import itertools
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from orchestrate.store import NoDatabaseError, Reader, StoreError
from tests.orchestrate.faults.gate import Gate
from tests.orchestrate.faults.outcome import Rows, flaws, results
from tests.orchestrate.faults.program import Order, carry_out, errors_beside
from tests.orchestrate.store.places import execute
from tests.orchestrate.store.processes import CLEAN
from tests.waiting import PATIENCE_SECONDS, until


@dataclasses.dataclass
class Launched:
    """A launch that runs, or has ended."""

    process: BaseProcess
    output: Path

    @property
    def pid(self) -> int:
        assert self.process.pid is not None
        return self.process.pid

    @property
    def said(self) -> str:
        return self.output.read_text()

    @property
    def errors(self) -> str:
        return errors_beside(self.output).read_text()

    @property
    def paused(self) -> bool:
        """Whether it has come to where it was to stop for ever."""
        return self.output.with_suffix(".paused").exists()

    def send(self, number: signal.Signals) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        """Kill -9, and wait until the kernel has taken everything back."""
        self.process.kill()
        self.process.join(PATIENCE_SECONDS)

    def until(self, condition: Callable[[], object]) -> None:
        """Wait for what the launch must live to see."""
        until(lambda: condition() or not self.process.is_alive())
        assert condition(), f"it ended too early: {self.said}{self.errors}"

    def end(self) -> int:
        """Wait for the end and return the exit code."""
        self.process.join(PATIENCE_SECONDS)
        if self.process.exitcode is None:
            self.send(signal.SIGUSR1)  # it writes down where it stands
            self.process.join(10.0)
        assert self.process.exitcode is not None, f"it does not end: {self.said}{self.errors}"
        return self.process.exitcode

    def workers(self) -> list[int]:
        return children(self.pid)


@dataclasses.dataclass
class Laboratory:
    """Launches one grid into one database, again and again.

    Attributes
    ----------
    expected
        Function that gives what an undisturbed run of the grid leaves; called where it is compared.
    gate
        Gate of all its trials, by which a test has the launch at work when the fault comes.
    """

    folder: Path
    order: Order
    expected: Callable[[], Rows]
    gate: Gate = dataclasses.field(init=False)
    _numbers: Iterator[int] = dataclasses.field(default_factory=itertools.count)

    def __post_init__(self) -> None:
        self.gate = Gate(self.folder)
        self.order = dataclasses.replace(self.order, gate=str(self.folder))

    @property
    def url(self) -> str:
        return self.order.url

    @contextmanager
    def launched(self, **changes: Any) -> Iterator[Launched]:
        """Launch, with some fields of the order replaced; it is dead after the block."""
        output = self.folder / f"launch-{next(self._numbers)}.txt"
        for path in (output, errors_beside(output)):
            path.touch()
        order = dataclasses.replace(self.order, **changes)
        process = CLEAN.Process(target=carry_out, args=(order, output), daemon=True)
        process.start()
        launched = Launched(process, output)
        try:
            yield launched
        finally:
            launched.kill()

    def complete(self, **changes: Any) -> str:
        """Give the same command once more, let it end well and return what it said.

        Its trials take no time, and no processes of their own where it would start them itself:
        nothing has to happen while they run. The gate opens.
        """
        self.gate.open()
        executor = "inprocess" if self.order.executor == "local" else self.order.executor
        with self.launched(**{"seconds": 0.0, "executor": executor, **changes}) as launched:
            code = launched.end()
        assert code == 0, launched.said + launched.errors
        self.check()
        return launched.said

    def check(self, but: int | None = None) -> None:
        """See that the grid is complete and equal to the undisturbed run, but for one seed."""
        assert flaws(self.url) == []
        found = results(self.url, but)
        for name, rows in self.expected().items():
            assert found[name] == [row for row in rows if row[0] != but], name

    def check_whole(self) -> None:
        """See that what there is, is whole, although not everything is there."""
        assert flaws(self.url) == []
        expected = self.expected()
        for name, rows in results(self.url).items():
            if name != "summary":
                assert set(rows) <= set(expected[name]), name

    def count(self, condition: str = "status IN ('done', 'diverged')") -> int:
        """Count trials; none while the database is not there or does not answer."""
        try:
            return int(self.query(f"SELECT count(*) FROM trial WHERE {condition}")[0][0])
        except (NoDatabaseError, StoreError):
            return 0

    def end_lease(self, launched: Launched) -> None:
        """Let the lease of a dead launch run out, as time does; SQLite has none."""
        dead = f"pid = {launched.pid} AND lease_until > 0"
        execute(self.url, f"UPDATE launch SET lease_until = 0 WHERE {dead}")

    def query(self, sql: str) -> list[tuple[Any, ...]]:
        with Reader.open(self.url) as reader:
            return [tuple(row) for row in reader.rows(sql)]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children(pid: int) -> list[int]:
    """Return the processes that a process has started, whichever of its threads did."""
    found: list[int] = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        found += map(int, path.read_text().split())
    return found


def command_line(pid: int) -> str:
    """Return the words of a process's command, or nothing once it is gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""
