"""Laboratory of the faults: a server, a grid in a database, launches that can be hurt, outcomes."""

from __future__ import annotations

import dataclasses
import itertools
import os
import random
import shutil
import signal
import socket
import subprocess
import tempfile
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import psycopg

from orchestrate.store import NoDatabaseError, Reader, StoreError
from tests.orchestrate.faults.program import Order, begun_beside, carry_out, errors_beside
from tests.orchestrate.faults.trials import Gate
from tests.orchestrate.store.databases import execute
from tests.orchestrate.store.processes import CLEAN
from tests.waiting import PATIENCE_SECONDS, until

Rows = dict[str, list[tuple[Any, ...]]]

_RESULTS = {
    "summary": "SELECT seed, trial_key, status, n_steps, final_loss, best_loss, diverged_at "
    "FROM trial ORDER BY seed",
    "curve": "SELECT r.seed, s.t, s.loss, s.reachable_loss, s.plan_us, s.learn_us, s.evaluate_us "
    "FROM step s JOIN trial r ON r.trial_id = s.trial_id ORDER BY r.seed, s.t",
    "trajectory": "SELECT r.seed, p.dtype, p.states_shape, p.states, p.inputs_shape, p.inputs, "
    "p.parameters_shape, p.parameters "
    "FROM trajectory p JOIN trial r ON r.trial_id = p.trial_id ORDER BY r.seed",
    "assessment": "SELECT r.seed, a.t, a.measure, a.value "
    "FROM assessment a JOIN trial r ON r.trial_id = a.trial_id ORDER BY r.seed, a.t, a.measure",
}

_FINISHED = "r.status IN ('done', 'diverged')"
_STEPS = "(SELECT count(*) FROM step s WHERE s.trial_id = r.trial_id)"
_TRAJECTORIES = "(SELECT count(*) FROM trajectory p WHERE p.trial_id = r.trial_id)"
_ASSESSMENTS = "(SELECT count(*) FROM assessment b WHERE b.trial_id = r.trial_id)"
_MOST = (
    "(SELECT coalesce(max(n), 0) FROM (SELECT count(*) AS n FROM assessment GROUP BY trial_id) k)"
)
_ATTEMPTS = "(SELECT count(*) FROM attempt a WHERE a.trial_id = r.trial_id)"
_WITH_ATTEMPTS = "trial r JOIN attempt a ON a.trial_id = r.trial_id"

_FLAWS = {
    "has part of a curve": "SELECT r.seed FROM trial r JOIN config c ON c.config_id = r.config_id "
    f"WHERE {_STEPS} <> CASE WHEN {_FINISHED} THEN c.horizon ELSE 0 END",
    "has not one trajectory for its curve": "SELECT r.seed FROM trial r "
    f"WHERE {_TRAJECTORIES} <> CASE WHEN {_FINISHED} THEN 1 ELSE 0 END",
    "has part of an assessment": "SELECT r.seed FROM trial r "
    f"WHERE {_ASSESSMENTS} <> CASE WHEN {_FINISHED} THEN {_MOST} ELSE 0 END",
    "was finished twice": f"SELECT r.seed FROM {_WITH_ATTEMPTS} "
    "WHERE a.outcome IN ('done', 'diverged') GROUP BY r.seed HAVING count(*) > 1",
    "has attempts that nobody counted": "SELECT r.seed FROM trial r "
    f"WHERE r.attempt <> {_ATTEMPTS}",
    "has an outcome that its last attempt does not have": f"SELECT r.seed FROM {_WITH_ATTEMPTS} "
    "WHERE a.attempt = r.attempt AND r.status IN ('done', 'diverged', 'failed') "
    "AND (a.outcome IS NULL OR a.outcome <> r.status)",
    "has an earlier attempt without an end": f"SELECT r.seed FROM {_WITH_ATTEMPTS} "
    "WHERE a.attempt < r.attempt AND (a.outcome IS NULL OR a.ended IS NULL "
    "OR a.outcome NOT IN ('lost', 'released', 'failed'))",
    "was claimed before its earlier attempt ended": "SELECT r.seed FROM trial r "
    "JOIN attempt a ON a.trial_id = r.trial_id "
    "JOIN attempt b ON b.trial_id = a.trial_id AND b.attempt = a.attempt + 1 "
    "WHERE b.claimed < a.ended",
    "is owned though it does not run": "SELECT r.seed FROM trial r "
    "WHERE (r.status = 'running') <> (r.owner IS NOT NULL)",
}


def results(url: str, but: int | None = None) -> Rows:
    """Return everything that the trials left, without times and places, by seed.

    ``but`` is the seed of a trial to leave out.
    """
    with Reader.open(url) as reader:
        return {
            name: [tuple(row) for row in reader.rows(sql) if row[0] != but]
            for name, sql in _RESULTS.items()
        }


def flaws(url: str) -> list[str]:
    """Return what is wrong with the database, one sentence for each trial."""
    with Reader.open(url) as reader:
        return [
            f"the trial with seed {row[0]} {flaw}"
            for flaw, sql in _FLAWS.items()
            for row in reader.rows(sql)
        ]


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

    def ends(self, code: int = 0, *sentences: str) -> None:
        """See that it ends with the code and, where it fails, with one error and no traceback."""
        assert self.end() == code, self.said + self.errors
        assert "Traceback" not in self.errors
        assert self.errors.count("error:") == (code == 75)
        for sentence in sentences:
            assert sentence in self.said + self.errors, self.said + self.errors

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
            until(lambda: begun_beside(output).exists() or not process.is_alive())
            yield launched
        finally:
            launched.kill()

    def run(self, code: int = 0, *sentences: str, **changes: Any) -> Launched:
        """Launch, and see that it ends with the code and says the sentences."""
        with self.launched(**changes) as launched:
            launched.ends(code, *sentences)
        return launched

    def complete(self, **changes: Any) -> str:
        """Give the same command once more, let it end well and return what it said.

        Its trials take no time, and no processes of their own where it would start them itself:
        nothing has to happen while they run. The gate opens.
        """
        self.gate.open()
        executor = "inprocess" if self.order.executor == "local" else self.order.executor
        launched = self.run(**{"seconds": 0.0, "executor": executor, **changes})
        self.check()
        return launched.said

    def check(self, but: int | None = None) -> None:
        """See that the grid is complete and equal to the undisturbed run, except for one seed."""
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
        if self.url.startswith("postgresql"):
            dead = f"pid = {launched.pid} AND lease_until > 0"
            execute(self.url, f"UPDATE launch SET lease_until = 0 WHERE {dead}")

    def query(self, sql: str) -> list[tuple[Any, ...]]:
        with Reader.open(self.url) as reader:
            return [tuple(row) for row in reader.rows(sql)]


def alive(pid: int) -> bool:
    try:
        return _state(Path(f"/proc/{pid}/stat")) != "Z"
    except OSError:
        return False


def stands_still(pid: int) -> bool:
    """Return whether all threads of a process are stopped."""
    try:
        return {*map(_state, Path(f"/proc/{pid}/task").glob("*/stat"))} == {"T"}
    except OSError:  # one has just ended
        return False


def _state(file: Path) -> str:
    return file.read_text().rpartition(")")[2].split()[0]


def children(pid: int) -> list[int]:
    """Return the processes that a process has started, whichever of its threads did."""
    found: list[int] = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):  # the thread may end at this moment
            found += map(int, path.read_text().split())
    return found


def command_line(pid: int) -> str:
    """Return the words of a process's command, or nothing once it is gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""


ENDED = "status NOT IN ('pending', 'running')"

PREEMPTIONS = (signal.SIGTERM, signal.SIGUSR1, signal.SIGKILL)

EXIT_CODES = {0, 130}
"""A worker that is asked to leave may find that everything is done."""


def preempt(
    laboratory: Laboratory, workers: int, every: int, chance: random.Random, **worker: object
) -> Counter[str]:
    """Run the registered grid on workers of which one is replaced after ``every`` trials.

    Returns how often each signal was sent.
    """
    sent: Counter[str] = Counter()
    with ExitStack() as stack:

        def start() -> Launched:
            return stack.enter_context(laboratory.launched(worker=worker))

        laboratory.gate.let(0)  # or a test that is slow finds most trials ended at its first look
        running = [start() for _ in range(workers)]
        # A database that does not answer at the moment counts as one in which nothing has ended.
        while (ended := laboratory.count(ENDED)) < laboratory.order.trials - 4 * every:
            laboratory.gate.let(2 * every)  # so that the victim is at work, and not at its end
            until(lambda: laboratory.count(ENDED) >= ended + every)  # called at once
            victim = chance.choice(running)
            victim.until(lambda: "trials wait" in victim.said)  # noqa: B023
            number = chance.choice(PREEMPTIONS)
            running[running.index(victim)] = start()
            sent[number.name] += 1
            leave(victim, number)
            if number == signal.SIGKILL:
                laboratory.end_lease(victim)
        laboratory.gate.open()
        codes = [one.end() for one in running]
    assert set(codes) == {0}, codes
    return sent


def leave(worker: Launched, number: signal.Signals) -> None:
    """Send a worker a signal and wait until it has left as it should."""
    worker.send(number)
    code = worker.end()
    allowed = EXIT_CODES | ({-signal.SIGKILL} if number == signal.SIGKILL else set())
    assert code in allowed, f"{number.name}: {code}: {worker.said}{worker.errors}"
    assert "Traceback" not in worker.errors, worker.errors


ACCOUNT = "postgres"
"""User of the system that the server runs as where we are root, which it refuses to be."""

_OTHERS = "FROM pg_stat_activity WHERE backend_type = 'client backend' AND pid <> pg_backend_pid()"


class Server:
    """A cluster in a folder of its own, on a free port of the loopback address."""

    def __init__(self) -> None:
        self._bin = binaries()
        # Beside pytest's folder, which only we may enter: in memory, where each table is made in a
        # quarter of the time.
        place = os.environ.get("PYTEST_DEBUG_TEMPROOT")
        self.folder = Path(tempfile.mkdtemp(prefix="dopt-postgresql-", dir=place))
        self.port = _free_port()
        if os.geteuid() == 0:
            shutil.chown(self.folder, ACCOUNT)
        self._run("initdb", "--auth=trust", f"--username={ACCOUNT}", "--no-sync", "-D", self._data)
        self.start()

    @property
    def url(self) -> str:
        return f"postgresql+psycopg://{ACCOUNT}@127.0.0.1:{self.port}/postgres"

    @property
    def _data(self) -> str:
        return str(self.folder / "data")

    def start(self) -> None:
        self._control("start", "-l", str(self.folder / "log"), "-o", self._options())

    def restart(self, mode: str) -> None:
        """Restart "fast", which rolls back and says goodbye, or "immediate", which does not."""
        log = str(self.folder / "log")
        self._control("restart", "-m", mode, "-l", log, "-o", self._options())

    def stop(self, mode: str = "fast") -> None:
        self._control("stop", "-m", mode)

    def remove(self) -> None:
        """Stop the server if it runs, and delete all that it has."""
        if (self.folder / "data" / "postmaster.pid").exists():
            self.stop("immediate")
        shutil.rmtree(self.folder)

    def terminate_backends(self) -> int:
        """End every connection except our own; return how many there were."""
        rows = self.query(f"SELECT pg_terminate_backend(pid) {_OTHERS}")
        return len(rows)

    def new_url(self) -> str:
        """Return the URL of a new, empty schema."""
        schema = f"lab_{uuid.uuid4().hex[:8]}"
        self.query(f"CREATE SCHEMA {schema}")
        return f"{self.url}?options=-csearch_path%3D{schema}"

    def query(self, sql: str) -> list[tuple[Any, ...]]:
        address = f"host=127.0.0.1 port={self.port} user={ACCOUNT} dbname=postgres"
        with psycopg.connect(address, autocommit=True, connect_timeout=60) as connection:
            cursor = connection.execute(sql)  # type: ignore[arg-type]
            return cursor.fetchall() if cursor.description else []

    def _options(self) -> str:
        # Without fsync a power failure would cost data, the death of the server does not.
        settings = {"listen_addresses": "127.0.0.1", "fsync": "off", "max_connections": "60"}
        words = [f"-c {key}={value}" for key, value in settings.items()]
        return " ".join([f"-p {self.port}", f"-k {self.folder}", *words])

    def _control(self, *arguments: str) -> None:
        self._run("pg_ctl", "-w", "-t", f"{PATIENCE_SECONDS:.0f}", "-D", self._data, *arguments)

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(self._bin / program), *arguments]
        if os.geteuid() == 0:
            command = ["runuser", "-u", ACCOUNT, "--", *command]
        # Into a file: the server inherits it, and a pipe would not end before the server does.
        with (self.folder / f"{program}.txt").open("w+") as output:
            done = subprocess.run(command, cwd=self.folder, stdout=output, stderr=output)
            output.seek(0)
            assert done.returncode == 0, output.read()


def binaries() -> Path:
    """Return the folder of the newest server's programs.

    Raises
    ------
    FileNotFoundError
        If PostgreSQL is not installed.
    """
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    on_path = shutil.which("initdb")
    if not found and not on_path:
        raise FileNotFoundError("there is no initdb: install PostgreSQL's server")
    return found[-1].parent if found else Path(str(on_path)).resolve().parent


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])
