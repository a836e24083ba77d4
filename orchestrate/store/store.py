"""Write side of the results database: outcomes, written by the holder of a claim, and saves."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from sqlalchemy import (
    URL,
    Connection,
    Integer,
    bindparam,
    delete,
    insert,
    literal_column,
    or_,
    select,
    text,
    union,
    update,
)

from dopt.types import Array
from orchestrate.errors import InvalidResultError, StoreError, without_password
from orchestrate.records import Failure, RunRecord
from orchestrate.store import records, schema
from orchestrate.store.backend import Backend, parse_url
from orchestrate.store.launches import GridRows, Launches, begin_attempts, living, register, renew
from orchestrate.store.postgresql import PostgreSQLBackend
from orchestrate.store.records import (
    DTYPE,
    Claim,
    finite,
    not_before,
    pack,
    plain,
    storable,
    unpack,
    utc_text,
)
from orchestrate.store.schema import (
    ENDED,
    FINISHED,
    OUTCOME_COLUMNS,
    PREQUENTIAL,
    RUN_COLUMNS,
    STEP_VALUES,
    assessment,
    attempt,
    config,
    curve,
    error,
    step,
    trajectory,
    trial,
)
from orchestrate.store.sqlite import SQLiteBackend

if TYPE_CHECKING:
    from dopt.result import Assessment, TrialResult
    from dopt.spec.trial import MarkedTrial


LEASE_SECONDS = 60.0
PATIENCE_SECONDS = 30.0

PAGE = 50
"""Trials that are deleted in one transaction, so that a launch waits for less than a second."""


def make_backend(
    url: URL, lease_seconds: float = LEASE_SECONDS, patience: float = PATIENCE_SECONDS
) -> Backend:
    """Return the backend of a database, without checking or creating anything in it."""
    if url.get_backend_name() == "sqlite":
        return SQLiteBackend(url, patience)
    return PostgreSQLBackend(url, lease_seconds, patience)


@dataclass(frozen=True)
class Saved:
    """Attempt at a trial under which a session has saved, and the number of saved steps."""

    claim: Claim
    n_steps: int


class Store(Launches):
    """Writable results database; every method is one atomic transaction.

    Every method raises ``StoreUnavailableError`` if the database fails.
    """

    @classmethod
    def open(
        cls,
        url: str,
        lease_seconds: float = LEASE_SECONDS,
        patience: float = PATIENCE_SECONDS,
        repeat: Callable[[Callable[[], None]], None] = lambda create: create(),
    ) -> Self:
        """Open a database; create it where nothing is yet.

        ``lease_seconds`` is the time after its last heartbeat for which a launch on PostgreSQL is
        alive; on SQLite a file lock decides. ``patience`` bounds the wait for a lock of another
        process [s]. ``repeat`` calls what creates or checks the tables, and may do so again after
        a failure. Raises ``SchemaVersionError`` for another version.
        """
        backend = make_backend(parse_url(url), lease_seconds, patience)

        def create() -> None:
            with backend.creation() as connection:
                if schema.is_empty(connection):
                    schema.create(connection)
                else:
                    schema.check(connection, backend.safe_url)

        try:
            repeat(create)
        except BaseException:
            backend.close()
            raise
        return cls(backend)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def safe_url(self) -> str:
        """The URL without a password."""
        return self._backend.safe_url

    def check(self) -> None:
        """Raise ``DatabaseMovedError`` if the file was removed, renamed or replaced."""
        self._backend.check()

    def commit(self, claim: Claim, result: TrialResult, run: RunRecord) -> bool:
        """Write a finished trial with its curve and trajectory; return False if the claim is lost.

        Raises ``InvalidResultError``, and writes nothing, for an invalid result.
        """
        return self.commit_many([(claim, result, run)])[0]

    def commit_many(self, items: Sequence[tuple[Claim, TrialResult, RunRecord]]) -> list[bool]:
        """Write finished trials in one transaction; return False for each lost claim.

        Raises ``InvalidResultError``, and writes nothing, if one result is invalid.
        """
        prepared = [_prepare(*item) for item in items]
        written = [False] * len(prepared)
        # All launches use one order, which avoids deadlocks.
        order = sorted(range(len(prepared)), key=lambda i: prepared[i].claim.trial_id)
        with self._backend.transaction() as connection:
            for i in order:
                written[i] = _write(connection, self._backend, prepared[i])
        return written

    def fail(self, claim: Claim, failure: Failure, run: RunRecord) -> bool:
        """Write a failed trial with its error; return False if the claim is lost."""
        values = {
            "status": "failed",
            **dict.fromkeys(_RESULT_COLUMNS),
            "cause": failure.cause,
            **_run_row(run),
        }
        with self._backend.transaction() as connection:
            if _pass_fence(connection, claim, values) is None:
                return False
            values["error_id"] = _error_id(connection, failure)
            connection.execute(_SET_ERROR, {"fence_trial": claim.trial_id, **values})
            _end_attempt(connection, claim, values)
        return True

    def written(self, claims: Sequence[Claim]) -> list[bool]:
        """Return for each claim whether its attempt has an outcome."""
        statement = select(attempt.c.outcome).where(
            attempt.c.trial_id == bindparam("fence_trial"),
            attempt.c.attempt == bindparam("fence_attempt"),
        )
        with self._backend.transaction() as connection:
            outcomes = [
                connection.execute(statement, _attempt_key(claim)).scalar_one_or_none()
                for claim in claims
            ]
        return [outcome in (*FINISHED, "failed") for outcome in outcomes]

    def holds_more(self, spec: MarkedTrial, result: TrialResult) -> bool:
        """Return whether more steps of an exploration are stored; raises as :meth:`save`."""
        with self._backend.transaction() as connection:
            return _is_longer(connection, self._backend, spec, result)

    def save(
        self,
        launch: int,
        spec: MarkedTrial,
        result: TrialResult,
        run: RunRecord,
        last: Saved | None = None,
    ) -> Saved | None:
        """Write an exploration or a fit as it is now, in place of what was stored of it.

        ``last`` is what the last save of this launch has returned; with it the new steps are
        appended. Returns None, and writes nothing, if more steps of it are stored. Raises
        ``StoreError`` for another exploration of the same key, and ``InvalidResultError``.
        """
        self.check()
        backend = self._backend
        with backend.transaction() as connection:
            backend.exclusive(connection)  # before any row is locked, as everywhere
            renew(connection, backend, launch)
            if last is None or last.n_steps > len(result.loss) or not _is_mine(connection, last):
                last = _take(connection, backend, launch, spec, result)
            if last is None:
                return None
            rows = _prepare(last.claim, result, run)
            _write_steps(connection, backend, rows, last.n_steps)
            _replace_arrays(connection, rows)
            outcome = {name: rows.summary[name] for name in ("status", *OUTCOME_COLUMNS)}
            connection.execute(
                update(trial)
                .where(trial.c.trial_id == last.claim.trial_id)
                .values(**outcome, attempt=last.claim.attempt, launch_id=launch, owner=None)
            )
            _end_attempt(connection, last.claim, rows.summary)
        return Saved(last.claim, len(result.loss))

    def add_assessments(self, measured: Mapping[str, Assessment]) -> int:
        """Write a measure of trials that are done, by trial key, and return their number.

        It takes the place of a stored value of the same step. Other trials are left as they are.
        """
        self.check()
        keys = self._backend.members(list(measured))
        done = trial.c.trial_key.in_(keys) & (trial.c.status == "done")
        chosen = select(trial.c.trial_key, trial.c.trial_id).where(done).with_for_update()
        with self._backend.transaction() as connection:
            found = connection.execute(chosen).all()
            for key, trial_id in found:
                row = _assessment_row(trial_id, measured[key])
                same = [assessment.c[name] == row[name] for name in ("trial_id", "t", "measure")]
                connection.execute(delete(assessment).where(*same))
                connection.execute(insert(assessment), row)
        return len(found)

    def prune(self, trial_keys: Sequence[str]) -> int:
        """Delete the trials that have an outcome, and return their number.

        Trials of a living launch stay. The trials are deleted in several transactions, so that
        launches wait for none of them long; one that was interrupted can be repeated.
        """
        deleted = 0
        for start in range(0, len(trial_keys), PAGE):
            page = self._backend.members(trial_keys[start : start + PAGE])
            with self._backend.transaction() as connection:
                alive = [one.launch_id for one in living(connection, self._backend)]
                chosen = (
                    select(trial.c.trial_id)
                    .where(trial.c.trial_key.in_(page), trial.c.status.in_(ENDED))
                    .where(or_(trial.c.launch_id.is_(None), trial.c.launch_id.not_in(alive)))
                    .order_by(trial.c.trial_id)
                    .with_for_update()
                )
                found = list(connection.execute(chosen).scalars())
                for table in (step, trajectory, assessment, curve, attempt, trial):
                    connection.execute(delete(table).where(table.c.trial_id.in_(found)))
                deleted += len(found)
        with self._backend.transaction() as connection:
            _prune_unused(connection, self._backend)
        return deleted

    def close(self) -> None:
        """Close connections and locks; a launch that has not ended counts as dead from now on."""
        self._backend.close()


def _faults(result: TrialResult) -> Iterator[str]:
    """Yield why a result is inconsistent; the first fault may be the cause of the others."""
    n, at = len(result.loss), result.diverged_at
    shapes: dict[str, tuple[int | None, ...]] = dict.fromkeys(STEP_VALUES, (n,))
    shapes |= {"states": (n + 1, None), "inputs": (n, None), "parameters": (None,)}
    for name, expected in shapes.items():
        shape = np.shape(getattr(result, name))
        if len(shape) != len(expected) or any(
            want not in (None, got) for got, want in zip(shape, expected, strict=True)
        ):
            yield f"'{name}' has shape {shape}, expected {expected} (None means any length)"
    loss = np.isfinite(np.asarray(result.loss, dtype=np.float64))
    if at is None and not loss.all():
        yield f"the loss of step {int(np.argmin(loss))} is not finite, but 'diverged_at' is None"
    if at is not None and not 0 <= at < n:
        yield f"'diverged_at' is {at}, expected a step below {n}"
    if at is not None and loss[at:].any():
        yield f"there are losses after the divergence at step {at}"
    for row in result.assessments:
        if not 0 <= row.t <= result.n_steps:
            yield f"'{row.measure}' is of step {row.t}, expected one from 0 to {result.n_steps}"
    counts = Counter((row.t, row.measure) for row in result.assessments)
    yield from (f"'{name}' of step {t} is given twice" for (t, name), k in counts.items() if k > 1)


def _refusal(trial_key: str, reason: str) -> InvalidResultError:
    return InvalidResultError(
        f"The result of trial {trial_key[:12]} was not stored: {reason}; correct what made it."
    )


_RESULT_COLUMNS = tuple(name for name in OUTCOME_COLUMNS if name not in RUN_COLUMNS)

# As text: SQLAlchemy omits table names in RETURNING on SQLite, and a bare config_id would be the
# one of the inner table.
_HORIZON = literal_column(
    "(SELECT config.horizon FROM config WHERE config.config_id = trial.config_id)", Integer
)

# Fencing: only the launch that still holds the claim of this attempt may write.
_FENCED = (
    update(trial)
    .where(
        trial.c.trial_id == bindparam("fence_trial"),
        trial.c.owner == bindparam("fence_owner"),
        trial.c.attempt == bindparam("fence_attempt"),
        trial.c.status == "running",
    )
    .values(
        status=bindparam("status"),
        owner=None,
        launch_id=bindparam("fence_owner"),
        error_id=None,
        **{name: bindparam(name) for name in OUTCOME_COLUMNS},
    )
    .returning(_HORIZON)
)
_END_ATTEMPT = (
    update(attempt)
    .where(
        attempt.c.trial_id == bindparam("fence_trial"),
        attempt.c.attempt == bindparam("fence_attempt"),
    )
    .values(
        outcome=bindparam("status"),
        cause=bindparam("cause"),
        error_id=bindparam("error_id"),
        **{name: bindparam(name) for name in (*RUN_COLUMNS, "pid")},
        **{name: not_before(attempt.c.claimed, bindparam(name)) for name in ("started", "ended")},
    )
)
_SET_ERROR = (
    update(trial)
    .where(trial.c.trial_id == bindparam("fence_trial"))
    .values(error_id=bindparam("error_id"))
)
# An update locks a row that exists, so that none that is referred to can be pruned meanwhile.
_INSERT_ERROR = text(
    "INSERT INTO error (hash, type, message, traceback) "
    "VALUES (:hash, :type, :message, :traceback) "
    "ON CONFLICT (hash) DO UPDATE SET hash = excluded.hash RETURNING error_id"
)


@dataclass(frozen=True)
class _Rows:
    """Rows of a finished trial, prepared before the transaction to keep it short."""

    claim: Claim
    summary: dict[str, Any]
    steps: Array
    trajectory: dict[str, Any]
    assessments: list[dict[str, Any]]


def _prepare(claim: Claim, result: TrialResult, run: RunRecord) -> _Rows:
    """Check a result and return its rows; raise ``InvalidResultError`` if it is invalid."""
    if fault := next(_faults(result), None):
        raise _refusal(claim.trial_key, fault)
    steps = np.column_stack([getattr(result, name) for name in STEP_VALUES]).astype(np.float64)
    steps[~np.isfinite(steps)] = np.nan
    summary = {
        "status": "done" if result.diverged_at is None else "diverged",
        **_values(result, _RESULT_COLUMNS),
        "error_id": None,
        "cause": None,
        **_run_row(run),
    }
    arrays: dict[str, Any] = {"trial_id": claim.trial_id, "dtype": DTYPE}
    for name in ("states", "inputs", "parameters"):
        arrays[f"{name}_shape"], arrays[name] = pack(getattr(result, name))
    assessments = [_assessment_row(claim.trial_id, row) for row in result.assessments]
    return _Rows(claim, summary, steps, arrays, assessments)


def _assessment_row(trial_id: int, row: Assessment) -> dict[str, Any]:
    value = finite(row.value)
    return {"trial_id": trial_id, "t": int(row.t), "measure": row.measure, "value": value}


def _run_row(run: RunRecord) -> dict[str, Any]:
    return {
        **_values(run, RUN_COLUMNS),
        "pid": int(run.pid),
        "started": utc_text(run.started),
        "ended": utc_text(max(run.started, run.ended)),
    }


def _values(source: TrialResult | RunRecord, names: Sequence[str]) -> dict[str, Any]:
    """Return attributes as the database stores them: None for a number that is not finite."""
    found = {name: plain(getattr(source, name)) for name in names}
    return {name: finite(one) if isinstance(one, float) else one for name, one in found.items()}


def _write(connection: Connection, backend: Backend, rows: _Rows) -> bool:
    """Write a finished trial; return False, and write nothing, if the claim is lost."""
    horizon = _pass_fence(connection, rows.claim, rows.summary)
    if horizon is None:
        return False
    if len(rows.steps) != horizon:
        reason = f"there are {len(rows.steps)} steps, expected the horizon {horizon}"
        raise _refusal(rows.claim.trial_key, reason)
    backend.insert_steps(connection, rows.claim.trial_id, rows.steps)
    records.write_curves(connection, [(rows.claim.trial_id, rows.claim.attempt, rows.steps)])
    connection.execute(insert(trajectory), rows.trajectory)
    if rows.assessments:
        connection.execute(insert(assessment), rows.assessments)
    _end_attempt(connection, rows.claim, rows.summary)
    return True


def _pass_fence(connection: Connection, claim: Claim, values: Mapping[str, Any]) -> int | None:
    """Return the horizon of the trial, or None if the claim is lost."""
    fence = {"fence_owner": claim.launch, **_attempt_key(claim)}
    return connection.execute(_FENCED, {**fence, **values}).scalar_one_or_none()


def _end_attempt(connection: Connection, claim: Claim, values: Mapping[str, Any]) -> None:
    """Write the outcome of the attempt of a claim."""
    connection.execute(_END_ATTEMPT, {**_attempt_key(claim), **values})


def _attempt_key(claim: Claim) -> dict[str, int]:
    return {"fence_trial": claim.trial_id, "fence_attempt": claim.attempt}


def _error_id(connection: Connection, failure: Failure) -> int:
    row = {
        "type": storable(failure.type),
        "message": storable(without_password(failure.message)),
        "traceback": storable(without_password(failure.traceback)),
    }
    row["hash"] = hashlib.sha256("\0".join(row.values()).encode()).hexdigest()
    return insert_error(connection, row)


def insert_error(connection: Connection, row: Mapping[str, Any]) -> int:
    """Insert a traceback unless it is there, and return its id."""
    return int(connection.execute(_INSERT_ERROR, row).scalar_one())


def _prune_unused(connection: Connection, backend: Backend) -> None:
    """Delete configurations without a trial, and tracebacks without a trial or an attempt."""
    backend.exclusive(connection)
    used = select(trial.c.config_id).where(trial.c.config_id == config.c.config_id)
    connection.execute(delete(config).where(~used.exists()))
    named = (select(table.c.error_id) for table in (trial, attempt))
    kept = union(*(one.where(one.selected_columns.error_id.is_not(None)) for one in named))
    unused = error.c.error_id.not_in(kept)
    # Locked first: a trial that fails now may refer to one of them before it can be deleted.
    locked = select(error.c.error_id).where(unused).with_for_update(skip_locked=True)
    found = list(connection.execute(locked).scalars())
    for start in range(0, len(found), PAGE):
        page = found[start : start + PAGE]
        connection.execute(delete(error).where(error.c.error_id.in_(page), unused))


ROUNDING = 1e-6
"""Difference of two states, relative to their size or 1, that counts as none."""

Path = tuple[Array, Array]
"""States (T + 1, d) and inputs (T, m)."""


def steps_ahead(one: Path, other: Path) -> int | None:
    """Return how many steps the first path has more than the second; None for different paths.

    The last state of the shorter one is not compared: after a gap an exploration goes on from
    another state. States may be estimates, which another processor computes with other rounding.
    """
    n = min(len(one[1]), len(other[1]))
    states = (one[0][:n], other[0][:n])
    same = np.array_equal(one[1][:n], other[1][:n], equal_nan=True) and (
        states[0].shape == states[1].shape
        and np.allclose(*states, rtol=ROUNDING, atol=ROUNDING, equal_nan=True)
    )
    return len(one[1]) - len(other[1]) if same else None


def unpacked(row: Mapping[str, Any]) -> Path:
    """Return the path in a row of the table ``trajectory``."""
    states = unpack(row["dtype"], row["states_shape"], row["states"])
    return states, unpack(row["dtype"], row["inputs_shape"], row["inputs"])


def _is_longer(
    connection: Connection, backend: Backend, spec: MarkedTrial, result: TrialResult
) -> bool:
    """Return True if the stored exploration has more steps; a fit is always written again whole.

    Raises ``StoreError`` if it holds another exploration of the same key.
    """
    if PREQUENTIAL.strip("%") not in spec.config_json:
        return False
    statement = (
        select(trajectory)
        .join(trial, trial.c.trial_id == trajectory.c.trial_id)
        .where(trial.c.trial_key == spec.trial_key)
    )
    row = connection.execute(statement).mappings().one_or_none()
    if row is None:
        return False
    stored = unpacked(dict(row))
    ahead = steps_ahead(stored, (result.states, result.inputs))
    if ahead is None:
        raise StoreError(
            f"The results database {backend.safe_url} holds another exploration of the same "
            f"plant, policy, model, learner, steps and seed ({len(stored[1]):,} steps): explore "
            f"with another seed, or save to another database."
        )
    return ahead > 0


def _is_mine(connection: Connection, last: Saved) -> bool:
    """Return True if no other session has written the trial since; lock it."""
    statement = select(trial.c.trial_key, trial.c.attempt, trial.c.launch_id)
    one = statement.where(trial.c.trial_id == last.claim.trial_id).with_for_update()
    row = connection.execute(one).one_or_none()
    claim = last.claim
    return row is not None and tuple(row) == (claim.trial_key, claim.attempt, claim.launch)


def _take(
    connection: Connection, backend: Backend, launch_id: int, spec: MarkedTrial, result: TrialResult
) -> Saved | None:
    """Begin an attempt at the trial, without steps; return None if more of it is stored."""
    register(connection, backend, launch_id, GridRows([spec]))
    statement = select(trial.c.trial_id, trial.c.attempt).where(trial.c.trial_key == spec.trial_key)
    trial_id, attempts = connection.execute(statement.with_for_update()).one()
    if _is_longer(connection, backend, spec, result):
        return None
    claim = Claim(spec.trial_key, trial_id, attempts + 1, launch_id)
    begin_attempts(connection, [claim])
    connection.execute(delete(step).where(step.c.trial_id == trial_id))
    return Saved(claim, 0)


def _write_steps(connection: Connection, backend: Backend, rows: _Rows, n_stored: int) -> None:
    """Append the new steps; a diverged exploration gets steps of NaN up to the horizon."""
    trial_id, steps = rows.claim.trial_id, rows.steps
    if rows.summary["diverged_at"] is not None:
        statement = select(config.c.horizon).join(trial, trial.c.config_id == config.c.config_id)
        horizon = connection.execute(statement.where(trial.c.trial_id == trial_id)).scalar_one()
        missing = np.full((horizon - len(steps), steps.shape[1]), np.nan)
        steps, n_stored = np.concatenate([steps, missing]), 0
        connection.execute(delete(step).where(step.c.trial_id == trial_id))
    backend.insert_steps(connection, trial_id, steps[n_stored:], n_stored)
    records.write_curves(connection, [(trial_id, rows.claim.attempt, steps)])


def _replace_arrays(connection: Connection, rows: _Rows) -> None:
    """Replace the trajectory, and the measures of which there are new assessments."""
    trial_id = rows.claim.trial_id
    connection.execute(delete(trajectory).where(trajectory.c.trial_id == trial_id))
    connection.execute(insert(trajectory), rows.trajectory)
    if rows.assessments:
        new = assessment.c.measure.in_({row["measure"] for row in rows.assessments})
        connection.execute(delete(assessment).where(assessment.c.trial_id == trial_id, new))
        connection.execute(insert(assessment), rows.assessments)
