"""Read side of the results database, which cannot write or create anything.

One SELECT of a user runs in a process of its own with limits of time, memory and result: a database
library in this process could be neither interrupted nor kept from filling its memory.
"""

from __future__ import annotations

import io
import os
import pickle
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from select import POLLIN
from select import poll as new_poll
from types import ModuleType
from typing import Any, Self

import numpy as np
from sqlalchemy import URL, Connection, Engine, select, text
from sqlalchemy.exc import DBAPIError

from dopt.errors import suggestion
from orchestrate.errors import QueryError, without_password
from orchestrate.store import postgresql, query_process, schema, sqlite
from orchestrate.store.backend import (
    LaunchLife,
    is_of_driver,
    out_of_time,
    parse_url,
    public_url,
    translated,
    translated_query,
)
from orchestrate.store.query_process import MEMORY_BYTES, Request
from orchestrate.store.records import (
    Assessments,
    ConfigRow,
    Curves,
    LaunchRow,
    Table,
    Trajectory,
    TrialRow,
    read_curves,
    stored_json,
    unpacked_trajectory,
)
from orchestrate.store.schema import (
    FINISHED,
    PREQUENTIAL,
    STEP_VALUES,
    assessment,
    config,
    launch,
    trial,
)

RESULT_BYTES = 50_000_000
"""Most bytes of an answer."""

_PAUSE_MILLISECONDS = 100
_COMMAND = (sys.executable, "-I", "-S", query_process.__file__)


@contextmanager
def _process(request: Request) -> Iterator[subprocess.Popen[bytes]]:
    """Start the process, and kill it at the end of the block."""
    pipe, null = subprocess.PIPE, subprocess.DEVNULL
    try:
        # A session of its own: Ctrl-C is for this process, which kills the other.
        process = subprocess.Popen(
            _COMMAND, bufsize=0, stdin=pipe, stdout=pipe, stderr=null, start_new_session=True
        )
    except OSError as error:
        raise QueryError(
            f"The query needs a process, which cannot be started ({error.strerror}): end others."
        ) from error
    with process:
        try:
            assert process.stdin
            unsent = pickle.dumps(request)
            with suppress(BrokenPipeError):  # it was killed: its answer is empty
                while unsent:
                    unsent = unsent[process.stdin.write(unsent) :]
            yield process
        finally:
            process.kill()


def _read(
    process: subprocess.Popen[bytes], seconds: float | None, stopped: Callable[[], bool]
) -> bytes:
    """Return what the process writes; its time begins with the first byte."""
    assert process.stdout
    answer, end = bytearray(), float("inf")
    poll = new_poll()
    poll.register(process.stdout, POLLIN)
    while not stopped():
        if time.monotonic() > end:
            raise out_of_time(seconds)
        if not poll.poll(_PAUSE_MILLISECONDS):
            continue
        part = os.read(process.stdout.fileno(), 2**20)
        if not part:
            return bytes(answer)
        if not answer and seconds is not None:
            end = time.monotonic() + seconds
        answer += part
        if len(answer) > RESULT_BYTES:
            raise QueryError(
                f"The result is larger than {RESULT_BYTES / 1e6:g} MB, the most that a query "
                "returns: select fewer rows or columns, or take 'python -m orchestrate export'."
            )
    raise QueryError("The query was cancelled, because nobody waits for it: run it again.")


def _unpickled(answer: bytes) -> Iterator[Any]:
    stream = io.BytesIO(answer)
    with suppress(EOFError, pickle.UnpicklingError):
        while True:
            yield pickle.load(stream)


_LAUNCHES = select(launch).order_by(launch.c.launch_id)
_JSON = {"argv": list, "overrides": list, "versions": dict, "fingerprint": dict}


def _launch(row: Mapping[str, Any], alive: bool) -> LaunchRow:
    values = {one.name: row[one.name] for one in fields(LaunchRow) if one.name != "alive"}
    texts = {name: values[name] for name in _JSON if values[name] is not None}
    values |= {name: stored_json(text, _JSON[name]) for name, text in texts.items()}
    if values["git_dirty"] is not None:
        values["git_dirty"] = bool(values["git_dirty"])
    return LaunchRow(**values, alive=alive)


_CONFIGS = text(
    f"SELECT {', '.join(f'p.{one.name}' for one in fields(ConfigRow)[:-1])}, c.config_json "
    "FROM v_progress p JOIN config c ON c.config_key = p.config_key"
)
_TRIALS = text(
    f"SELECT {', '.join(one.name for one in fields(TrialRow))} "
    "FROM v_trial WHERE config_key = :config_key ORDER BY seed"
)
_MEASURES = (
    "SELECT DISTINCT measure FROM v_assessment WHERE config_key = :config_key ORDER BY measure"
)
_MIXED = (
    "SELECT c.config_key FROM trial r JOIN launch l ON l.launch_id = r.launch_id "
    "JOIN config c ON c.config_id = r.config_id WHERE r.status IN ('done', 'diverged') "
    "GROUP BY c.config_key HAVING count(DISTINCT l.fingerprint) > 1 ORDER BY c.config_key"
)
_TRAJECTORY = text(
    "SELECT j.dtype, j.states_shape, j.states, j.inputs_shape, j.inputs, j.parameters_shape, "
    "j.parameters FROM v_trial v JOIN trajectory j ON j.trial_id = v.trial_id "
    "WHERE v.config_key = :config_key AND v.seed = :seed"
)


class Reader:
    """Read-only results database; each method reads one snapshot.

    Every method raises ``StoreUnavailableError`` if the database fails.
    """

    def __init__(self, url: URL, engine: Engine, moment: Connection | None = None) -> None:
        self._url = url
        self._engine = engine
        self._moment = moment
        self._opening = moment is None
        self._kind = _kind(url)
        self.safe_url = public_url(url)

    @classmethod
    def open(cls, url: str) -> Self:
        """Open a database; raise ``NoDatabaseError`` or ``SchemaVersionError`` if that fails."""
        parsed = parse_url(url)
        reader = cls(parsed, _kind(parsed).read_engine(parsed))
        try:
            reader.schema_version()
        except BaseException:
            reader.close()
            raise
        reader._opening = False
        return reader

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._engine.dispose()

    @contextmanager
    def moment(self) -> Iterator[Self]:
        """Open a reader whose methods all read one snapshot, for one thread and a short time."""
        with self._snapshot() as connection:
            yield type(self)(self._url, self._engine, connection)

    def schema_version(self) -> str:
        """Return the version of the database's schema."""
        with self._snapshot() as connection:
            return str(schema.check(connection, self.safe_url))

    def size(self) -> int:
        """Return the bytes of the database."""
        with self._snapshot() as connection:
            return int(self._kind.size(connection))

    def configs(self) -> list[ConfigRow]:
        """Return all configurations, sorted by name, with the counts of their trials."""
        from dopt.spec.config import completed  # loads every class that it may meet

        with self._snapshot() as connection:
            configs = [
                ConfigRow(*values, completed(stored_json(content, dict)))  # type: ignore[call-arg]
                for *values, content in connection.execute(_CONFIGS)
            ]

        def name(row: ConfigRow) -> tuple[str | int, ...]:  # databases order letters differently
            sizes = (-1 if size is None else size for size in (row.width, row.depth))
            return (row.env, row.policy, row.model, row.learner, *sizes, row.config_key)

        return sorted(configs, key=name)

    def launches(self) -> list[LaunchRow]:
        """Return all launches that wrote to the database, the oldest first."""
        with self._snapshot() as connection:
            rows = [row._asdict() for row in connection.execute(_LAUNCHES)]
            running = [
                LaunchLife(row["launch_id"], row["token"], row["lease_until"])
                for row in rows
                if row["state"] == "running"
            ]
            gone = {one.launch_id for one in self._kind.dead(self._url, connection, running)}
        alive = {one.launch_id for one in running} - gone
        return [_launch(row, row["launch_id"] in alive) for row in rows]

    def mixed_code(self) -> list[str]:
        """Return the keys of configurations whose finished trials were run by different code."""
        return [row.config_key for row in self.rows(_MIXED)]

    def trials(self, config_key: str) -> list[TrialRow]:
        """Return the trials of a configuration by seed; none if it is unknown."""
        with self._snapshot() as connection:
            rows = connection.execute(_TRIALS, {"config_key": config_key})
            return [TrialRow(*row) for row in rows]

    def curves(self, config_key: str, column: str = "loss") -> Curves:
        """Return a column of the steps of all done and diverged trials of a configuration.

        Raises ``QueryError`` if the column or the configuration is unknown, and
        ``StoreUnavailableError`` if a step is missing.
        """
        if column not in STEP_VALUES:
            raise QueryError(f"A step has no column '{column}': {suggestion(column, STEP_VALUES)}")
        place = f"configuration {config_key[:12]} in {self.safe_url}"
        with self._snapshot() as connection:
            return read_curves(connection, *_config(connection, config_key), column, place)

    def assessments(self, config_key: str, measure: str) -> Assessments:
        """Return one measure of all done and diverged trials; empty if nothing was assessed.

        Raises ``QueryError`` if the configuration is unknown.
        """
        with self._snapshot() as connection:
            config_id, _ = _config(connection, config_key)
            finished = (trial.c.config_id == config_id) & trial.c.status.in_(FINISHED)
            columns = (trial.c.seed, trial.c.status, assessment.c.t, assessment.c.value)
            rows = connection.execute(
                select(*columns)
                .join(assessment, assessment.c.trial_id == trial.c.trial_id)
                .where(finished, assessment.c.measure == measure)
                .order_by(trial.c.seed)
            ).all()
        return _assessments(rows)

    def measures(self, config_key: str) -> list[str]:
        """Return the names of the measures of a configuration."""
        return [row.measure for row in self.rows(_MEASURES, config_key=config_key)]

    def trajectory(self, config_key: str, seed: int) -> Trajectory:
        """Return the arrays of one trial; raise ``QueryError`` if it has none."""
        values = {"config_key": config_key, "seed": int(seed)}
        with self._snapshot() as connection:
            row = connection.execute(_TRAJECTORY, values).one_or_none()
        if row is None:
            raise QueryError(
                f"There is no trajectory of seed {seed} of configuration {config_key[:12]} in "
                f"{self.safe_url}: run that trial first."
            )
        return unpacked_trajectory(*row)

    def query(
        self,
        sql: str,
        limit: int | None = None,
        timeout: float | None = None,
        login: URL | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> Table:
        """Return the rows of one SELECT, with values by position and by column name.

        Only the first ``limit`` rows are read; ``cut`` of the table is True if there are more.
        The statement runs in a process and through a connection of its own, with the URL ``login``
        where one is given. The process is killed after ``timeout`` seconds, when its answer is too
        large, when ``stopped`` says True, and with this process. Raises ``QueryError`` if the
        database rejects the statement, such as one that writes or several in one text, or if it
        takes longer than ``timeout`` seconds, 1 GiB of memory or 50 MB of rows.
        """
        request: Request = {
            **self._kind.request(login or self._url),
            **{"sql": sql, "seconds": timeout, "limit": None if limit is None else limit + 1},
            "path": [folder for folder in sys.path if folder],
        }
        with translated_query(self.safe_url, timeout):
            with _process(request) as process:
                parts = [None, *_unpickled(_read(process, timeout, stopped))]
            end = parts.pop()
            if not isinstance(end, dict):
                raise QueryError(
                    "The process of the query was killed before its end: run it again."
                )
            if isinstance(end["error"], MemoryError):
                raise QueryError(
                    f"The query needs more than {MEMORY_BYTES / 2**30:g} GiB of memory and was "
                    "ended: make it smaller."
                )
            if end["error"] is not None and is_of_driver(end["error"]):
                raise DBAPIError(sql, None, end["error"])
            if end["error"] is not None:
                raise QueryError(f"The query failed on {self.safe_url}: {end['error']}.")
        _, _, columns, *rows = parts
        if columns is None:
            raise QueryError("The query returns no rows: give one SELECT.")
        return Table(columns, rows[:limit], cut=limit is not None and len(rows) > limit)

    def rows(self, sql: str, /, **values: object) -> Table:
        """Return the rows of a trusted SELECT, with each ``:name`` in it bound to a value.

        Values are never part of the statement, so that they may come from users.
        """
        with self._snapshot() as connection:
            result = connection.execute(text(sql), values)
            return Table(result.keys(), result)

    def batches(self, size: int, sql: str, /, **values: object) -> Iterator[list[Sequence[Any]]]:
        """Yield the rows of a trusted SELECT in batches of ``size``."""
        with self._snapshot() as connection:
            options = {"yield_per": size}
            with connection.execute(text(sql), values, execution_options=options) as result:
                for rows in result.partitions(size):
                    yield list(rows)

    @contextmanager
    def _snapshot(self) -> Iterator[Connection]:
        with translated(self.safe_url, opening=self._opening):
            if self._moment is not None:
                yield self._moment
                return
            with self._engine.begin() as connection:
                yield connection


_KINDS = {"sqlite": sqlite, "postgresql": postgresql}


def _kind(url: URL) -> ModuleType:
    return _KINDS[url.get_backend_name()]


def _assessments(rows: Sequence[Sequence[Any]]) -> Assessments:
    """Return (seed, status, t, value) rows, sorted by seed, as a matrix."""
    status = {seed: status for seed, status, _, _ in rows}
    seeds, places = np.unique(np.array([row[0] for row in rows], np.int64), return_inverse=True)
    t, columns = np.unique(np.array([row[2] for row in rows], np.int64), return_inverse=True)
    values = np.full((len(seeds), len(t)), np.nan)
    values[places, columns] = np.array([row[3] for row in rows], np.float64)
    diverged = np.array([one == "diverged" for one in status.values()], dtype=np.bool_)
    return Assessments(seeds, t, values, diverged)


def _config(connection: Connection, config_key: str) -> tuple[int, int]:
    row = connection.execute(
        select(config.c.config_id, config.c.horizon).where(config.c.config_key == config_key)
    ).one_or_none()
    if row is None:
        raise QueryError(
            f"The configuration {config_key[:12]} is not in the database: "
            "take one of those that configs() returns."
        )
    return row[0], row[1]


_FAILURES = """
SELECT c.config_key, a.cause, a.error_id, e.type, e.message, count(*) AS attempts,
       sum(CASE WHEN r.status = 'failed' AND r.attempt = a.attempt THEN 1 ELSE 0 END) AS trials
FROM attempt a
JOIN trial r ON r.trial_id = a.trial_id
JOIN config c ON c.config_id = r.config_id
LEFT JOIN error e ON e.error_id = a.error_id
WHERE a.cause IS NOT NULL
GROUP BY c.config_key, a.cause, a.error_id, e.type, e.message
ORDER BY a.error_id
"""
_TRACEBACK = "SELECT traceback FROM error WHERE error_id = :error_id"
_NUMBER = re.compile(r"0x[0-9a-f]+|\d+(?:\.\d+)?(?:e[-+]?\d+)?", re.IGNORECASE)


@dataclass
class FailureKind:
    """Failures with one cause, type and message, up to the numbers in the message.

    Attributes
    ----------
    trials
        Trials whose last attempt failed in this way.
    attempts
        Attempts that failed in this way, including those followed by a successful one.
    places
        Names (env, policy) of the configurations.
    """

    cause: str
    type: str | None
    message: str | None
    error_id: int | None
    trials: int = 0
    attempts: int = 0
    places: set[tuple[str, str]] = field(default_factory=set)
    traceback: str = ""

    @property
    def last_line(self) -> str:
        """Last line of the traceback."""
        lines = self.traceback.strip().splitlines()
        return lines[-1].strip() if lines else ""

    @property
    def place(self) -> str:
        """Innermost frame of the traceback."""
        frames = re.findall(r"^ *File (.+)$", self.traceback, flags=re.MULTILINE)
        return frames[-1] if frames else ""


def failure_kinds(
    reader: Reader, configs: Mapping[str, ConfigRow], tracebacks: int
) -> list[FailureKind]:
    """Return the failures of the configurations, given by key, the commonest kind first.

    The commonest ``tracebacks`` kinds have the traceback of one of their attempts.
    """
    found: dict[tuple[str, ...], FailureKind] = {}
    for row in reader.rows(_FAILURES):
        if row.config_key in configs:
            name = (row.cause, row.type or "", _NUMBER.sub("#", row.message or ""))
            new = FailureKind(row.cause, row.type, row.message, row.error_id)
            kind = found.setdefault(name, new)
            kind.attempts += row.attempts
            kind.trials += row.trials
            config = configs[row.config_key]
            kind.places.add((config.env, config.policy))
    kinds = sorted(found.values(), key=lambda kind: (-kind.trials, -kind.attempts, kind.cause))
    for kind in kinds[:tracebacks]:
        if kind.error_id is not None:
            kind.traceback = str(reader.rows(_TRACEBACK, error_id=kind.error_id)[0][0])
    return kinds


_EXPLORATIONS = f"""
SELECT v.trial_key, v.config_key, v.env, v.label, v.seed, v.status, v.n_steps, v.horizon,
       v.launch_id
FROM v_trial v
JOIN config c ON c.config_key = v.config_key
WHERE c.config_json LIKE '{PREQUENTIAL}' AND v.status IN ('done', 'diverged')
ORDER BY v.trial_id
"""


@dataclass(frozen=True)
class ExplorationRow:
    """Exploration that was saved.

    Attributes
    ----------
    n_steps, horizon
        Steps that are stored, and the most that there can be.
    is_running
        Whether the process that saves it is alive and can add steps.
    """

    trial_key: str
    config_key: str
    env: str
    label: str
    seed: int
    status: str
    n_steps: int
    horizon: int
    is_running: bool

    @property
    def state(self) -> str:
        """Status and steps, such as ``running, 1,234 of 20,000 steps``."""
        word = "running" if self.is_running else self.status
        return f"{word}, {self.n_steps:,} of {self.horizon:,} steps"


def explorations(reader: Reader) -> list[ExplorationRow]:
    """Return all stored explorations, the oldest first."""
    rows = list(reader.rows(_EXPLORATIONS))
    if not rows:
        return []
    alive = {one.launch_id for one in reader.launches() if one.state == "running" and one.alive}
    found = []
    for row in rows:
        values = row._asdict()
        is_saved = values.pop("launch_id") in alive
        grows = is_saved and row.status == "done" and row.n_steps < row.horizon
        found.append(ExplorationRow(**values, is_running=grows))
    return found


_TRIAL = "SELECT * FROM v_trial WHERE trial_id = :trial_id"
_CONFIG = "SELECT config_json FROM config WHERE config_key = :config_key"
_ATTEMPTS = """
SELECT a.attempt, a.launch_id, a.outcome, a.cause, a.node, a.pid, a.claimed, a.started, a.ended,
       a.wall_seconds, a.cpu_seconds, a.peak_memory_bytes, e.type, e.message, e.traceback
FROM attempt a
LEFT JOIN error e ON e.error_id = a.error_id
WHERE a.trial_id = :trial_id
ORDER BY a.attempt
"""
_LOSS = "SELECT loss FROM step WHERE trial_id = :trial_id ORDER BY t"
_BEYOND = """
SELECT measure, value FROM assessment
WHERE trial_id = :trial_id AND measure IN ('violations', 'worst') ORDER BY t, measure
"""


@dataclass(frozen=True)
class TrialReport:
    """Contents of the database about one trial.

    Attributes
    ----------
    trial
        Row of ``v_trial``.
    config
        The whole configuration without the seed.
    launches
        The launches that ran it, without passwords.
    attempts
        One for each claim, with its error if there was one.
    loss
        The loss curve, with None for values that are not finite; empty without one.
    beyond_limits
        ``violations`` and ``worst`` of a trial with limits (:data:`dopt.assessment.MEASURES`).
    exploration
        Steps of an exploration, and whether it goes on; None for another trial.
    """

    trial: Mapping[str, Any]
    config: Mapping[str, Any]
    launches: Sequence[Mapping[str, Any]]
    attempts: Sequence[Mapping[str, Any]]
    loss: Sequence[float | None]
    beyond_limits: Mapping[str, float | None]
    exploration: ExplorationRow | None = None


def trial_report(reader: Reader, trial_id: int) -> TrialReport:
    """Return the report of a trial; ``reader`` is a snapshot."""
    from dopt.spec.config import completed

    trial = reader.rows(_TRIAL, trial_id=trial_id)[0]._asdict()
    attempts = [row._asdict() for row in reader.rows(_ATTEMPTS, trial_id=trial_id)]
    tried = {attempt["launch_id"] for attempt in attempts}
    ((text,),) = reader.rows(_CONFIG, config_key=trial["config_key"])
    return TrialReport(
        trial=trial,
        config=completed(stored_json(text, dict)),
        launches=[public(one) for one in reader.launches() if one.launch_id in tried],
        attempts=attempts,
        loss=[row[0] for row in reader.rows(_LOSS, trial_id=trial_id)],
        beyond_limits={row[0]: row[1] for row in reader.rows(_BEYOND, trial_id=trial_id)},
        exploration=next(
            (one for one in explorations(reader) if one.trial_key == trial["trial_key"]), None
        ),
    )


def public(launch: LaunchRow) -> dict[str, Any]:
    """Return a launch without passwords."""
    row = asdict(launch)
    return row | {name: [*map(without_password, row[name])] for name in ("argv", "overrides")}
