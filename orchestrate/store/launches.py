"""Launches: registration of a grid, claims of its trials, leases, recovery, and open trials.

A claim takes a trial from pending to a launch. It goes back when the launch releases it, or when
another launch finds that its process is gone.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    Select,
    TextClause,
    delete,
    insert,
    or_,
    select,
    text,
    update,
)

from orchestrate.errors import LaunchAliveError
from orchestrate.store.backend import Backend, LaunchLife, NewTrial
from orchestrate.store.records import (
    Claim,
    LaunchRecord,
    Registration,
    not_before,
    now,
    plain,
    stored_json,
)
from orchestrate.store.schema import (
    CONFIG_COLUMNS,
    ENDED,
    FINISHED,
    LAUNCH_STATES,
    OUTCOME_COLUMNS,
    PREQUENTIAL,
    RETRIED,
    assessment,
    attempt,
    config,
    curve,
    step,
    trajectory,
    trial,
)
from orchestrate.store.schema import launch as launch_table

if TYPE_CHECKING:
    from dopt.spec.trial import MarkedTrial, TrialSpec


@dataclass
class OpenConfig:
    """Configuration with trials that have no outcome; a worker keeps the numbers up to date.

    Attributes
    ----------
    pending, running
        Number of its trials that wait, and that a launch has claimed.
    mean_seconds, max_seconds
        Wall time of its finished trials; None without one.
    """

    config_id: int
    config_key: str
    config_json: str
    pending: int
    running: int
    mean_seconds: float | None
    max_seconds: float | None


@dataclass(frozen=True)
class OpenTrial:
    """Pending trial.

    Attributes
    ----------
    crashes
        Deaths of a process that ran it, or ran it in one chunk with others, as a living launch saw.
    lone_losses
        Losses of a whole launch that held this trial and no other; counted for suspects only.
    """

    trial_key: str
    config_id: int
    seed: int
    crashes: int
    lone_losses: int = 0


# Of trials that code with the fingerprint of the launch has registered.
_ALIKE = (
    "registered_by IN (SELECT l.launch_id FROM launch l JOIN launch m "
    "ON coalesce(m.fingerprint, '') = coalesce(l.fingerprint, '') WHERE m.launch_id = :launch)"
)
_CONFIGS = text(
    "SELECT c.config_id, c.config_key, c.config_json, s.pending, s.running, s.mean, s.longest "
    f"FROM (SELECT config_id, count(*) FILTER (WHERE status = 'pending' AND {_ALIKE}) AS pending, "
    f"count(*) FILTER (WHERE status = 'running' AND {_ALIKE}) AS running, "
    "avg(wall_seconds) FILTER (WHERE status IN ('done', 'diverged')) AS mean, "
    "max(wall_seconds) FILTER (WHERE status IN ('done', 'diverged')) AS longest "
    "FROM trial GROUP BY config_id) AS s JOIN config c ON c.config_id = s.config_id "
    "WHERE s.pending + s.running > 0 ORDER BY c.config_id"
)
_OTHERS = text(
    "SELECT l.fingerprint, count(*) FROM trial r LEFT JOIN launch l "
    "ON l.launch_id = r.registered_by WHERE r.status IN ('pending', 'running') "
    f"AND (r.registered_by IS NULL OR NOT r.{_ALIKE}) GROUP BY l.fingerprint ORDER BY 2 DESC"
)


def _attempts(trial: str, condition: str) -> str:
    """Return SQL that counts the attempts of a trial since it last failed."""
    failed = (
        "coalesce((SELECT max(f.attempt) FROM attempt f "
        f"WHERE f.trial_id = {trial}.trial_id AND f.outcome = 'failed'), 0)"
    )
    return (
        f"(SELECT count(*) FROM attempt a WHERE a.trial_id = {trial}.trial_id "
        f"AND a.attempt > {failed} AND {condition})"
    )


_LOST = "a.outcome = 'lost'"
# A query of its own that refers to no trial, so that it is carried out once.
_LONE = (
    f"{_LOST} AND a.launch_id IN (SELECT b.launch_id FROM attempt b WHERE b.outcome = 'lost' "
    "GROUP BY b.launch_id HAVING min(b.trial_id) = max(b.trial_id))"
)
_CRASHES = _attempts("r", "a.cause IN ('killed', 'out of memory')")

# Trials that were never claimed, nearly all of them, need no look at their attempts. Workers that
# look at the same time see different trials first.
_TRIALS = text(
    f"SELECT r.trial_key, r.config_id, r.seed, {_CRASHES} AS crashes FROM trial r "
    "WHERE r.trial_id IN (SELECT p.trial_id FROM trial p "
    f"WHERE p.config_id = :config_id AND p.status = 'pending' AND p.{_ALIKE} "
    f"AND (p.attempt < :losses OR {_attempts('p', _LOST)} < :losses) "
    "ORDER BY random() LIMIT :size)"
)
_SUSPECTS = text(
    f"SELECT r.trial_key, r.config_id, r.seed, 0 AS crashes, {_attempts('r', _LONE)} AS lone "
    f"FROM trial r WHERE r.status = 'pending' AND r.attempt >= :losses AND r.{_ALIKE} "
    f"AND {_attempts('r', _LOST)} >= :losses ORDER BY r.attempt, r.trial_id"
)


class Launches:
    """Launches of a :class:`orchestrate.store.Store`, claims, leases, recovery, and open trials."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    def new_token(self) -> str:
        """Return a name for a launch, which no other one has."""
        return self._backend.token()

    def begin_launch(self, record: LaunchRecord, token: str | None = None) -> int:
        """Insert a launch that starts now and return its number.

        With a ``token`` of :meth:`new_token` it can be repeated: a launch of that name that is
        there is alive again, although others may have taken it for dead meanwhile.
        """
        token = token or self._backend.token()
        begun = select(launch_table.c.launch_id).where(launch_table.c.token == token)
        statement = insert(launch_table).values(
            token=token,
            state="running",
            started=now(),
            host=record.host,
            pid=int(record.pid),
            argv=json.dumps(list(record.argv)),
            overrides=json.dumps(list(record.overrides)),
            git_commit=record.git_commit,
            git_dirty=None if record.git_dirty is None else int(record.git_dirty),
            git_diff_hash=record.git_diff_hash,
            versions=json.dumps(dict(record.versions), sort_keys=True),
            fingerprint=record.fingerprint and json.dumps(dict(record.fingerprint), sort_keys=True),
        )
        try:
            with self._backend.transaction() as connection:
                launch_id = connection.execute(begun).scalar_one_or_none()
                if launch_id is None:
                    inserted = connection.execute(statement.returning(launch_table.c.launch_id))
                    launch_id = inserted.scalar_one()
                # Before the transaction ends: no other process finds a launch without its lock or
                # lease and takes it for dead.
                self._backend.hold(token)
                renew(connection, self._backend, launch_id)
                return int(launch_id)
        except BaseException:
            self._backend.forget(token)
            raise

    def end_launch(self, launch: int, state: str, exit_code: int | None = None) -> None:
        """End a launch as "done", "failed", "interrupted" or "lost" and release its claims."""
        if state not in LAUNCH_STATES[1:]:
            states = ", ".join(LAUNCH_STATES[1:])
            raise ValueError(f"A launch cannot end as '{state}': give {states}.")
        statement = (
            update(launch_table)
            .where(launch_table.c.launch_id == launch)
            .values(
                state=state,
                ended=not_before(launch_table.c.started, now()),
                lease_until=None,
                exit_code=None if exit_code is None else int(exit_code),
            )
            .returning(launch_table.c.token)
        )
        with self._backend.transaction() as connection:
            token = connection.execute(statement).scalar_one_or_none()
            if token is None:
                raise ValueError(
                    f"There is no launch {launch}: end one that begin_launch returned."
                )
            free_claims(connection, [launch], "released")
        self._backend.forget(token)

    def heartbeat(self, launch: int) -> None:
        """Renew the lease of the launch; on PostgreSQL, call it several times in a lease."""
        with self._backend.transaction() as connection:
            renew(connection, self._backend, launch)

    def recover(self) -> int:
        """Put the trials of dead launches back to pending; return their number.

        Rows that another transaction has locked are skipped and left for the next recovery: that
        transaction ends soon, or :meth:`Backend.evict` ends it.
        """
        self._backend.evict()
        with self._backend.transaction() as connection:
            self._backend.exclusive(connection)
            dead = self._backend.dead(connection, maybe_alive(connection, skip_locked=True))
            ids = [one.launch_id for one in dead]
            freed = free_claims(connection, ids, "lost", skip_locked=True)
            connection.execute(
                update(launch_table)
                .where(launch_table.c.launch_id.in_(ids), launch_table.c.state == "running")
                .values(state="lost", ended=not_before(launch_table.c.started, now()))
            )
        for one in dead:
            self._backend.forget(one.token)
        return freed

    def register(self, launch: int, specs: Iterable[TrialSpec]) -> Registration:
        """Register a grid and return the state of its trials; repeated calls are harmless."""
        grid = GridRows(specs)
        with self._backend.transaction() as connection:
            return register(connection, self._backend, launch, grid)

    def claim(self, launch: int, trial_keys: Sequence[str], *, alike: bool = False) -> list[Claim]:
        """Claim the pending ones of the trials, in the given order.

        ``alike`` leaves out what code with another fingerprint has registered.
        """
        free = (
            select(trial.c.trial_id)
            .where(trial.c.trial_key.in_(self._backend.members(trial_keys)))
            .where(trial.c.status == "pending")
            .with_for_update(skip_locked=True)
        )
        if alike:
            free = free.where(text(_ALIKE).bindparams(launch=launch))
        statement = (
            update(trial)
            .where(trial.c.trial_id.in_(free))
            .values(status="running", owner=launch, attempt=trial.c.attempt + 1)
            .returning(trial.c.trial_key, trial.c.trial_id, trial.c.attempt)
        )
        with self._backend.transaction() as connection:
            renew(connection, self._backend, launch)
            rows = connection.execute(statement)
            claims = {key: Claim(key, place, number, launch) for key, place, number in rows}
            begin_attempts(connection, claims.values())
        return [claims[key] for key in dict.fromkeys(trial_keys) if key in claims]

    def release(
        self, launch: int, trial_keys: Sequence[str] | None = None, cause: str | None = None
    ) -> int:
        """Put running trials of the launch, all or those given, back to pending; count them.

        ``cause`` is recorded in their attempts.
        """
        only = None if trial_keys is None else self._backend.members(trial_keys)
        with self._backend.transaction() as connection:
            return free_claims(connection, [launch], "released", only, cause)

    def retry(self, status: str = "failed", trial_keys: Sequence[str] | None = None) -> int:
        """Put finished trials of a status back to pending and return their number.

        ``status`` is "failed", "diverged", "cancelled" or "all" of these; ``trial_keys`` restricts
        them to a grid. What they had written is deleted. Explorations stay, as no launch can run
        them again.
        """
        if status not in RETRIED:
            raise ValueError(
                f"Trials cannot be retried by the status '{status}': give {', '.join(RETRIED)}."
            )
        explored = select(config.c.config_id).where(config.c.config_json.like(PREQUENTIAL))
        which: ColumnElement[bool] = trial.c.status.in_(RETRIED[status])
        which = which & trial.c.config_id.not_in(explored)
        if trial_keys is not None:
            which = which & trial.c.trial_key.in_(self._backend.members(trial_keys))
        empty = dict.fromkeys((*OUTCOME_COLUMNS, "launch_id", "error_id"))
        reset = update(trial).where(which).values({"status": "pending", **empty})
        with self._backend.transaction() as connection:
            self._backend.exclusive(connection)
            keys = list(connection.execute(reset.returning(trial.c.trial_key)).scalars())
            # By the keys: a launch may write another outcome of the same status meanwhile.
            members = self._backend.members(keys)
            chosen = select(trial.c.trial_id).where(trial.c.trial_key.in_(members))
            for table in (step, trajectory, assessment, curve):
                connection.execute(delete(table).where(table.c.trial_id.in_(chosen)))
        return len(keys)

    def final_losses(self, trial_keys: Sequence[str]) -> dict[str, float]:
        """Return the final loss of each given trial that is done and did not diverge."""
        statement = select(trial.c.trial_key, trial.c.final_loss).where(
            trial.c.trial_key.in_(self._backend.members(trial_keys)),
            trial.c.status == "done",
            trial.c.final_loss.is_not(None),
        )
        with self._backend.transaction() as connection:
            return {key: float(loss) for key, loss in connection.execute(statement)}

    def open_configs(self, launch: int) -> list[OpenConfig]:
        """Return the configurations that have trials without an outcome.

        Only trials count that a launch with the fingerprint of this one has registered.
        """
        return [OpenConfig(*row) for row in self._rows(_CONFIGS, launch=launch)]

    def others(self, launch: int) -> list[tuple[dict[str, str] | None, int]]:
        """Return the other fingerprints with which open trials were registered, and their counts.

        None is the fingerprint of a program that stored none.
        """
        rows = self._rows(_OTHERS, launch=launch)
        return [(stored and stored_json(stored, dict), count) for stored, count in rows]

    def open_trials(self, launch: int, config_id: int, size: int, losses: int) -> list[OpenTrial]:
        """Return some pending trials of a configuration that lost fewer launches than ``losses``.

        A launch with the fingerprint of this one has registered them. They come in a random order,
        so that workers rarely choose the same ones.
        """
        given = {"launch": launch, "config_id": config_id, "size": size, "losses": losses}
        return [OpenTrial(*row) for row in self._rows(_TRIALS, **given)]

    def suspects(self, launch: int, losses: int) -> list[OpenTrial]:
        """Return the pending trials, as above, whose launch was lost at least ``losses`` times."""
        return [OpenTrial(*row) for row in self._rows(_SUSPECTS, launch=launch, losses=losses)]

    def _rows(self, statement: TextClause, **given: int) -> Sequence[Sequence[Any]]:
        with self._backend.transaction() as connection:
            return connection.execute(statement, given).all()


def begin_attempts(connection: Connection, claims: Iterable[Claim]) -> None:
    """Insert the attempts of new claims."""
    moment = now()
    rows = [
        {
            "trial_id": one.trial_id,
            "attempt": one.attempt,
            "launch_id": one.launch,
            "claimed": moment,
        }
        for one in claims
    ]
    if rows:
        connection.execute(insert(attempt), rows)


def free_claims(
    connection: Connection,
    launch_ids: Sequence[int],
    outcome: str,
    only: Select[Any] | None = None,
    cause: str | None = None,
    skip_locked: bool = False,
) -> int:
    """Put running trials of the launches back to pending, those with a key in ``only`` if given.

    ``skip_locked`` leaves out rows that another transaction has locked.
    """
    if not launch_ids:
        return 0
    held = trial.c.owner.in_(launch_ids) & (trial.c.status == "running")
    open_attempt = attempt.c.launch_id.in_(launch_ids) & attempt.c.outcome.is_(None)
    if only is not None:
        chosen = select(trial.c.trial_id).where(trial.c.trial_key.in_(only))
        held = held & trial.c.trial_id.in_(chosen)
        open_attempt = open_attempt & attempt.c.trial_id.in_(chosen)
    still_held = select(trial.c.trial_id).where(held)
    if skip_locked:
        held = held & trial.c.trial_id.in_(still_held.with_for_update(skip_locked=True))
    # Trials first, as a commit does, so that the two cannot wait for each other.
    freed = connection.execute(update(trial).where(held).values(status="pending", owner=None))
    over = open_attempt & attempt.c.trial_id.not_in(still_held)
    end = {"outcome": outcome, "cause": cause, "ended": not_before(attempt.c.claimed, now())}
    connection.execute(update(attempt).where(over).values(end))
    return freed.rowcount


def renew(connection: Connection, backend: Backend, launch_id: int) -> None:
    """Renew the lease of the launch; one that was marked as lost is running again."""
    connection.execute(
        update(launch_table)
        .where(launch_table.c.launch_id == launch_id, launch_table.c.state == "lost")
        .values(state="running", ended=None, exit_code=None)
    )
    backend.renew(connection, launch_id)


def maybe_alive(connection: Connection, skip_locked: bool = False) -> list[LaunchLife]:
    """Return the launches whose state is running or that still own a trial.

    The statement uses only columns that every schema version has, because the upgrade of an older
    database calls it too. ``skip_locked`` leaves out launches whose lease another transaction is
    renewing.
    """
    owners = select(trial.c.owner).where(trial.c.owner.is_not(None))
    statement = (
        select(launch_table.c.launch_id, launch_table.c.token, launch_table.c.lease_until)
        .where(or_(launch_table.c.state == "running", launch_table.c.launch_id.in_(owners)))
        # FOR NO KEY UPDATE: another transaction that renews the lease waits for this one. A commit
        # of a result only checks that the launch exists (FOR KEY SHARE), does not wait, and so
        # cannot deadlock with this one.
        .with_for_update(key_share=True, skip_locked=skip_locked)
    )
    return [LaunchLife(*row) for row in connection.execute(statement)]


def living(connection: Connection, backend: Backend) -> list[LaunchLife]:
    """Return the launches whose process lives."""
    candidates = maybe_alive(connection)
    dead = {one.launch_id for one in backend.dead(connection, candidates)}
    return [one for one in candidates if one.launch_id not in dead]


def refuse_living(connection: Connection, backend: Backend) -> None:
    """Raise ``LaunchAliveError`` if a launch is running."""
    alive = [one.launch_id for one in living(connection, backend)]
    if not alive:
        return
    columns = select(launch_table.c.launch_id, launch_table.c.pid, launch_table.c.host)
    row = connection.execute(columns.where(launch_table.c.launch_id == min(alive))).one()
    raise LaunchAliveError(
        f"Launch {row.launch_id} (process {row.pid} on {row.host}) is running in "
        f"{backend.safe_url}: wait for its end, or stop it, and run the same command again."
    )


_BATCH_ROWS = 10_000


class GridRows:
    """Distinct trials of a grid, as rows of the database."""

    def __init__(self, specs: Iterable[TrialSpec | MarkedTrial]) -> None:
        self.trials: dict[str, tuple[str, int]] = {}  # trial_key -> config_key, seed
        self.configs: dict[str, dict[str, Any]] = {}
        for spec in specs:
            config_key = spec.config_key
            known = self.configs.get(config_key)
            if known is None:
                known = self.configs[config_key] = _config_row(spec)
            # The string of the row is shared by all trials of the configuration.
            self.trials.setdefault(spec.trial_key, (known["config_key"], int(plain(spec.seed))))


def _config_row(spec: TrialSpec | MarkedTrial) -> dict[str, Any]:
    columns = spec.columns()
    if set(columns) != set(CONFIG_COLUMNS):
        raise ValueError(
            f"A configuration has the columns {', '.join(columns)}: "
            f"expected {', '.join(CONFIG_COLUMNS)}."
        )
    if PREQUENTIAL.strip("%") not in spec.config_json:  # what was measured is not run again
        from dopt.registry import check_importable  # loaded with the specifications

        for key, section in json.loads(spec.config_json).items():
            check_importable(key, section)
    values = {name: plain(value) for name, value in columns.items()}
    return {"config_key": spec.config_key, "config_json": spec.config_json, **values}


def register(
    connection: Connection, backend: Backend, launch_id: int, grid: GridRows
) -> Registration:
    """Insert new configurations and trials, and return the state of the grid."""
    backend.exclusive(connection)
    before = _config_ids(connection, backend, list(grid.configs))
    added = [row for key, row in grid.configs.items() if key not in before]
    if added:
        connection.execute(insert(config), added)
    config_ids = _config_ids(connection, backend, list(grid.configs)) if added else before
    found: dict[str, tuple[str, int | None]] = {}
    every, columns = list(grid.trials), (trial.c.trial_key, trial.c.status, trial.c.owner)
    for start in range(0, len(every), _BATCH_ROWS):
        keys = every[start : start + _BATCH_ROWS]
        # A configuration that was not there has no trials.
        old = backend.members([key for key in keys if grid.trials[key][0] in before])
        rows = connection.execute(select(*columns).where(trial.c.trial_key.in_(old)))
        known = {key: (status, owner) for key, status, owner in rows}
        _take_over(connection, backend, launch_id, list(known))
        places = ((key, *grid.trials[key]) for key in keys if key not in known)
        trials = [NewTrial(key, config_ids[config_key], seed) for key, config_key, seed in places]
        if trials:
            backend.insert_trials(connection, trials, launch_id)
        found.update({key: known.get(key, ("pending", None)) for key in keys})
    return _summary(found, launch_id)


def _config_ids(connection: Connection, backend: Backend, keys: Sequence[str]) -> dict[str, int]:
    statement = select(config.c.config_key, config.c.config_id).where(
        config.c.config_key.in_(backend.members(keys))
    )
    return {row[0]: row[1] for row in connection.execute(statement)}


def _take_over(
    connection: Connection, backend: Backend, launch_id: int, keys: Sequence[str]
) -> None:
    """Let workers with the code of this launch run trials that other code has registered."""
    if not keys:
        return
    theirs = text(f"NOT {_ALIKE}").bindparams(launch=launch_id)
    others = (
        select(trial.c.trial_id)
        .where(trial.c.trial_key.in_(backend.members(keys)))
        .where(trial.c.status.not_in(("running", *FINISHED)))
        .where(or_(trial.c.registered_by.is_(None), theirs))
        .with_for_update(skip_locked=True)
    )
    taken = update(trial).where(trial.c.trial_id.in_(others))
    connection.execute(taken.values(registered_by=launch_id))


def _summary(found: Mapping[str, tuple[str, int | None]], launch_id: int) -> Registration:
    counts = Counter(status for status, _ in found.values())
    open_ = {key: owner for key, (status, owner) in found.items() if status not in ENDED}
    todo = [key for key, owner in open_.items() if owner in (None, launch_id)]
    ended = {status: counts[status] for status in ENDED}
    return Registration(len(found), **ended, running_elsewhere=len(open_) - len(todo), todo=todo)
