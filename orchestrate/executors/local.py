"""Executor on a pool of processes on this machine.

``concurrent.futures`` breaks the whole pool when one process dies and does not tell which task
caused it. Here each worker has its own socket, so that only the chunk of a dead worker is lost.

A worker is this module as a program. Chunks arrive on its socket, and outcomes are sent on it one
by one. A thread reads, so that neither side blocks on a full pipe, and so that the worker ends with
its driver. A dying process writes its stack to the second descriptor, and until it is ready
whatever it prints; then that goes to the third one.
"""

from __future__ import annotations

import faulthandler
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path

from dopt.errors import DoptError
from dopt.process import collect_rarely, usable_cores
from orchestrate.errors import InfrastructureError, LaunchError
from orchestrate.executors.base import (
    Event,
    Executor,
    ExecutorFactory,
    Run,
    Task,
    TaskDone,
    WorkerLost,
    check_processes,
    limits_of,
    run_task,
)
from orchestrate.executors.limits import (
    NO_LIMITS,
    ONE_THREAD,
    Limits,
    die_with_parent,
    ended_after,
    limit_memory,
    module_path,
    pin_threads,
)
from orchestrate.program import LIMITS, hiding

PREFETCHED_CHUNKS = 2
"""Chunks that a worker holds at once, so that it need not wait between two of them."""

MAX_FAILED_STARTS = 3
"""Consecutive workers that may die before they are ready; then the launch fails."""


DYING_SECONDS = 5.0
"""Time for a worker that has closed its socket to end by itself, with its exit code."""


class Worker:
    """Worker process as seen by the driver."""

    def __init__(self, run: Run, limits: Limits) -> None:
        ours, theirs = socket.socketpair()
        self._crash_report = CrashReport()
        try:
            with theirs, _standard_error() as errors:
                self.process = _start(theirs.fileno(), self._crash_report.descriptor, errors)
        except BaseException:
            ours.close()
            self._crash_report.close()
            raise
        self.connection = Connection(ours.detach())
        self.chunks: deque[deque[Task]] = deque()
        self.ready = False
        self.send((run, limits))

    def send(self, message: object) -> None:
        """Send a message; a dead worker is detected by the next receive."""
        try:
            self.connection.send(message)
        except (BrokenPipeError, ConnectionError):
            return

    def assign(self, chunk: Sequence[Task]) -> None:
        self.chunks.append(deque(chunk))
        self.send(list(chunk))

    def receive(self) -> list[Event]:
        """Return the outcomes that have arrived.

        Raises
        ------
        EOFError
            If the process has ended.
        """
        events: list[Event] = []
        try:
            while self.connection.poll():
                self._take(self.connection.recv(), events)
        except (EOFError, OSError):
            if not events:
                raise EOFError from None
        return events

    def _take(self, message: TaskDone | None, events: list[Event]) -> None:
        """Take an outcome, or None: first for "ready", then for each finished chunk."""
        if message is not None:
            self.chunks[0].popleft()
            events.append(message)
        elif self.ready:
            self.chunks.popleft()
        else:
            self.ready = True

    def end(self, seconds: float = 0.0) -> ExitStatus:
        """Kill the process if it still runs after some time, and return its exit status."""
        self.connection.close()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(seconds)
        self.process.kill()
        return self._crash_report.explain(self.process.wait())


class LocalExecutor(Executor):
    """Runs chunks on ``workers`` processes, by default one on each core that is usable."""

    def __init__(self, run: Run, workers: int | None = None, limits: Limits = NO_LIMITS) -> None:
        self._run = run
        self._limits = limits
        self.slots = workers or usable_cores()
        self._workers: list[Worker] = []
        self._queue: deque[Sequence[Task]] = deque()
        self._failed_starts = 0

    def start(self) -> None:
        try:
            for _ in range(self.slots):
                self._workers.append(self._worker())
        except BaseException:
            self.stop()
            raise

    def submit(self, chunk: Sequence[Task]) -> None:
        if chunk:
            self._queue.append(chunk)
            self._feed()

    def wait(self, timeout: float) -> list[Event]:
        by_connection = {worker.connection: worker for worker in self._workers}
        events: list[Event] = []
        for ready in wait(list(by_connection), timeout):
            worker = by_connection[ready]  # type: ignore[index]
            try:
                events += worker.receive()
            except EOFError:
                events += self._replace(worker)
        self._feed()
        return events

    @property
    def pending(self) -> int:
        return len(self._queue) + sum(len(worker.chunks) for worker in self._workers)

    def stop(self) -> None:
        for worker in self._workers:
            worker.end()
        self._workers.clear()
        self._queue.clear()

    def _feed(self) -> None:
        while self._queue:
            worker = min(self._workers, key=lambda worker: len(worker.chunks))
            if len(worker.chunks) >= PREFETCHED_CHUNKS:
                return
            worker.assign(self._queue.popleft())

    def _replace(self, worker: Worker) -> list[Event]:
        """Replace a dead process; only the chunk that it was running is lost."""
        self._workers.remove(worker)
        end = worker.end(DYING_SECONDS)
        self._failed_starts = 0 if worker.ready else self._failed_starts + 1
        if self._failed_starts >= MAX_FAILED_STARTS:
            raise self._no_start(end, worker.process.returncode)
        chunks = [tuple(chunk) for chunk in worker.chunks]
        running = chunks.pop(0) if worker.ready and chunks else ()
        reason = end.reason
        if end.cause == "timeout":  # the first task exceeded it, the others have not begun
            running, chunks = running[:1], [running[1:], *chunks]
            reason = self._limits.timeout_message
        self._queue.extendleft(chunk for chunk in reversed(chunks) if chunk)
        self._workers.append(self._worker())
        if not running:
            return []
        keys, pid = tuple(task.key for task in running), worker.process.pid
        return [
            WorkerLost(keys, reason, False, end.cause, end.traceback, socket.gethostname(), pid)
        ]

    def _no_start(self, end: ExitStatus, code: int) -> DoptError:
        """Return the error for workers that do not become ready: what they printed is its cause."""
        printed = end.traceback.strip()
        if printed and code > 0:
            remedy = hiding(printed) or "mend the environment of this program."
            return LaunchError(f"Workers cannot start ({printed.splitlines()[-1]}): {remedy}")
        return InfrastructureError(
            f"{self._failed_starts} workers in a row died before they were ready "
            f"(last: {end.reason}): run the same command again."
        )

    def _worker(self) -> Worker:
        try:
            return Worker(self._run, self._limits)
        except OSError as error:
            if error.errno not in LIMITS:
                raise
            raise InfrastructureError(
                f"A worker process cannot be started ({error.strerror or error}): set "
                "launch.workers lower or raise the system's limits, and run the same command again."
            ) from error


def _start(*descriptors: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "orchestrate.executors.local", *map(str, descriptors)],
        pass_fds=descriptors,
        stdin=subprocess.DEVNULL,
        stdout=descriptors[1],
        stderr=descriptors[1],
        env={**os.environ, **ONE_THREAD, **module_path()},
        process_group=0,  # Ctrl-C in a terminal reaches the driver only
    )


@contextmanager
def _standard_error() -> Iterator[int]:
    """Yield a descriptor of the standard error, or of nothing where it is no file."""
    try:
        descriptor = os.dup(sys.stderr.fileno())
    except (OSError, ValueError):
        descriptor = os.open(os.devnull, os.O_WRONLY)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


FACTORY = ExecutorFactory(
    make=lambda settings, run, _: LocalExecutor(run, settings.workers, limits_of(settings)),
    trials_at_once=lambda settings: settings.workers or usable_cores(),
    check=check_processes,
    options=(),
)


_KERNEL_COUNTERS = Path("/proc/vmstat")


@dataclass(frozen=True)
class ExitStatus:
    """Description, cause and last stack of a process that has ended."""

    reason: str
    cause: str
    traceback: str


class CrashReport:
    """Anonymous file to which ``faulthandler`` writes the stack of a dying process."""

    def __init__(self) -> None:
        self.descriptor = os.memfd_create("crash report")
        self._kills = _kills_for_memory()

    def explain(self, code: int) -> ExitStatus:
        """Return the status for an exit code, negative for a signal; close the file."""
        stack = Path(f"/proc/self/fd/{self.descriptor}").read_text(errors="replace")
        self.close()
        if code == -signal.SIGKILL and _kills_for_memory() > self._kills:
            return ExitStatus("killed by the kernel: out of memory", "out of memory", stack)
        if stack.startswith("Timeout"):  # written by faulthandler
            return ExitStatus("killed: it ignored its time limit", "timeout", stack)
        reason = f"killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return ExitStatus(reason, "killed", stack)

    def close(self) -> None:
        """Close the file, which deletes it."""
        os.close(self.descriptor)


def _kills_for_memory() -> int:
    """Return the number of processes killed by the kernel for lack of memory; 0 if unknown."""
    try:
        lines = _KERNEL_COUNTERS.read_text().splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in lines if line.startswith("oom_kill "))


HANDLED_BY_DRIVER = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
"""Ctrl-C, and warnings before a preemption, which some batch systems send to every process."""


def main(descriptor: int, crash_report: int, errors: int) -> None:
    """Run chunks until the driver closes the socket."""
    for number in HANDLED_BY_DRIVER:
        signal.signal(number, signal.SIG_IGN)
    faulthandler.enable(crash_report)
    die_with_parent()
    pin_threads()
    collect_rarely()
    connection = Connection(descriptor)
    run: Run
    limits: Limits
    run, limits = connection.recv()
    chunks: queue.SimpleQueue[list[Task]] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(connection, chunks), daemon=True).start()
    with ended_after(limits, crash_report):
        pass  # a thread that the system does not give fails the start, and no trial
    _hand_over(crash_report, errors)
    connection.send(None)  # ready
    while True:
        for task in chunks.get():
            limit_memory(limits, task.memory_factor)
            with ended_after(limits, crash_report):
                finished = run_task(run, task, limits)
            connection.send(finished)
        connection.send(None)


def _hand_over(crash_report: int, errors: int) -> None:
    """Print to the standard error of the driver from now on; begin with what was printed so far."""
    sys.stdout.flush()
    printed = os.pread(crash_report, os.fstat(crash_report).st_size, 0)
    os.ftruncate(crash_report, 0)
    os.lseek(crash_report, 0, os.SEEK_SET)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(errors, stream.fileno())
    with suppress(OSError):  # nobody reads it any longer
        os.write(errors, printed)


def _read(connection: Connection, chunks: queue.SimpleQueue[list[Task]]) -> None:
    try:
        while True:
            chunks.put(connection.recv())
    except (EOFError, OSError):
        os._exit(0)  # the driver is gone: no one would receive the outcome
    finally:
        os._exit(1)  # out of memory, perhaps: the worker is useless without this thread


if __name__ == "__main__":
    try:
        main(*map(int, sys.argv[1:]))
    except (EOFError, ConnectionError):
        os._exit(0)
