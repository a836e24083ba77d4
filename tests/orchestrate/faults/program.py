"""The launch that the faults hit: the real one, of trials that are stand-ins.

Forked from a clean process, or run as ``python -m tests.orchestrate.faults.program ORDER OUTPUT``
with the order in JSON.
"""

from __future__ import annotations

import dataclasses
import faulthandler
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psycopg
from sqlalchemy import Engine, event

from orchestrate.config import LaunchSettings
from orchestrate.config.command_line import Request
from orchestrate.errors import ExitCode
from orchestrate.executors import local
from orchestrate.runner import scheduler, start, worker
from orchestrate.runner.start import Output, Work
from orchestrate.runner.worker import run_worker
from orchestrate.store import Store, StoreUnavailableError
from orchestrate.store.postgresql import PostgreSQLBackend
from orchestrate.store.sqlite import SQLiteBackend
from tests.orchestrate import lean_ray
from tests.orchestrate.faults.trials import Gate, Gated, Standin, grid_of, rest


@dataclass(frozen=True)
class Order:
    """What is launched.

    Attributes
    ----------
    seconds
        Duration of one trial.
    trouble
        What the trial with the broken seed does.
    gate
        Folder of the gate that all trials pass.
    pause
        Where the driver stops for ever: before it claims, in the middle of a commit, or
        on PostgreSQL in the middle of what it sends: the steps of a trial, or a claim.
    stop
        Beginning of the first statement before which the driver stops itself, until it is sent
        SIGCONT.
    settings
        Further settings of the launch.
    tick
        Seconds by which each trial at the gate sets the clock of a worker on; 0 for a real clock.
    worker
        Settings of a worker, which runs trials that are registered, in place of a launch.
    lone_losses
        Losses of a machine that ran only one trial after which the trial fails; 0 for the usual.
    environment
        Variables of the environment that must be there before the program starts.
    """

    url: str
    executor: str = "local"
    trials: int = 40
    seconds: float = 0.05
    trouble: str = ""
    gate: str = ""
    pause: str = ""
    stop: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    tick: float = 0.0
    worker: Mapping[str, Any] | None = None
    lone_losses: int = 0
    environment: Mapping[str, str] = field(default_factory=dict)


def carry_out(order: Order, output: Path) -> None:
    """Launch, write what is said to ``output`` and ``output``.err, and exit as a launch does."""
    for stream, path in ((1, output), (2, errors_beside(output))):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644), stream)
    faulthandler.register(signal.SIGUSR1)
    # As from a terminal: a test run in the background of a shell leaves Ctrl-C ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        begun_beside(output).touch()
        if order.environment:
            _start_again(order, output)
        if order.pause:
            _PAUSES[order.pause](lambda: _stop_for_ever(output.with_suffix(".paused")))
        if order.stop:
            _stop_before(order.stop)
        sys.exit(_launch(order))
    except KeyboardInterrupt:  # also while a library is imported
        sys.exit(ExitCode.INTERRUPTED)


def errors_beside(output: Path) -> Path:
    return output.with_suffix(".err")


def begun_beside(output: Path) -> Path:
    """Return the file that is there once signals are answered as by a launch."""
    return output.with_suffix(".begun")


def _start_again(order: Order, output: Path) -> None:
    """Become a new program with the environment, which is no part of what it is told."""
    told = json.dumps({**dataclasses.asdict(order), "environment": {}})
    words = [sys.executable, "-m", __name__, told, str(output)]
    os.execve(sys.executable, words, {**os.environ, **order.environment})


def _launch(order: Order) -> int:
    if order.executor == "ray":
        lean_ray.leave_services_out()
    # The counter is of the whole machine: another test may add a kill at any moment.
    local._kills_for_memory = lambda: 0
    scheduler.MAX_LONE_LOSSES = order.lone_losses or scheduler.MAX_LONE_LOSSES
    run = Gated(Standin(order.seconds, order.trouble), Gate(Path(order.gate)))
    work = Work(run)
    if order.worker is not None:
        return _pull(order, work)
    start.WORK = work
    chosen = {"workers": 2, "chunk_seconds": 0.2, **order.settings}
    settings = LaunchSettings(order.executor, order.url, **chosen)
    request = Request((), {}, (), single=False)
    return start.run(request, grid_of(order.trials), settings)


@dataclass(frozen=True)
class Clock:
    """The clock of a worker for which only its trials take time."""

    gate: Gate
    tick: float

    def monotonic(self) -> float:
        return self.gate.passed * self.tick

    sleep = staticmethod(time.sleep)


def _pull(order: Order, work: Work) -> int:
    if order.tick:
        clock = Clock(Gate(Path(order.gate)), order.tick)
        worker.time = worker.time = clock  # type: ignore[assignment]
    settings = {"processes": 2, **dict(order.worker or {})}
    try:
        return run_worker(order.url, Output(start.say, start.say, sys.stderr), work, **settings)
    except StoreUnavailableError as error:
        sys.stderr.write(f"{error}\n")
        return ExitCode.INFRASTRUCTURE


def _pause_before_claim(stop: Callable[[], None]) -> None:
    def claim(*_: object) -> None:
        stop()

    Store.claim = claim  # type: ignore[assignment]


def _pause_in_commit(stop: Callable[[], None]) -> None:
    """Stop with half of the steps of the third trial written."""
    for backend in (SQLiteBackend, PostgreSQLBackend):
        _pause_backend(backend, stop)


def _pause_backend(backend: Any, stop: Callable[[], None]) -> None:
    insert_steps, calls = backend.insert_steps, []

    def half(self: Any, connection: Any, trial_id: int, values: Any) -> None:
        calls.append(trial_id)
        last = len(calls) == 3
        insert_steps(self, connection, trial_id, values[: len(values) // 2] if last else values)
        if last:
            stop()

    backend.insert_steps = half


def _pause_in_copy(stop: Callable[[], None]) -> None:
    """Stop while the server waits for more rows of the third trial."""
    copies: list[object] = []
    write_row = psycopg.Copy.write_row

    def some(self: Any, row: Any) -> None:
        if self not in copies[-1:]:
            copies.append(self)
        write_row(self, row)
        if len(copies) == 3:
            stop()

    psycopg.Copy.write_row = some  # type: ignore[method-assign]


def _pause_in_pipeline(stop: Callable[[], None]) -> None:
    """Stop while a claim, which also holds the row of its launch, is sent in several messages."""
    claims: list[object] = []
    executemany = psycopg.Cursor.executemany

    def some(self: Any, query: Any, rows: Any, **options: Any) -> None:
        claims.extend([query] if b"INTO attempt" in bytes(query, "ascii") else [])
        if len(claims) < 3:
            executemany(self, query, rows, **options)
            return
        with self.connection.pipeline():
            self.execute(query, next(iter(rows)))
            self.connection.pgconn.send_flush_request()
            self.connection.pgconn.flush()
            stop()

    psycopg.Cursor.executemany = some  # type: ignore[assignment]


def _stop_before(beginning: str) -> None:
    stops = iter([signal.SIGSTOP])

    def listen(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        if statement.strip().startswith(beginning):
            for number in stops:
                os.kill(os.getpid(), number)

    event.listen(Engine, "before_cursor_execute", listen)


def _stop_for_ever(mark: Path) -> None:
    mark.touch()
    time.sleep(3600)


_PAUSES = {
    "claim": _pause_before_claim,
    "commit": _pause_in_commit,
    "copy": _pause_in_copy,
    "pipeline": _pause_in_pipeline,
}


if __name__ == "__main__":
    time.sleep = rest
    carry_out(Order(**json.loads(sys.argv[1])), Path(sys.argv[2]))
