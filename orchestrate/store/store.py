"""Write side of the results database."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Self

from sqlalchemy import URL

from orchestrate.records import Failure, RunRecord
from orchestrate.store import launches, results, schema
from orchestrate.store.backends.base import Backend, parse_url
from orchestrate.store.backends.postgresql import PostgreSQLBackend
from orchestrate.store.backends.sqlite import SQLiteBackend
from orchestrate.store.launches import OpenConfig, OpenTrial, final_losses
from orchestrate.store.records import Claim, LaunchRecord, Registrable, Registration
from orchestrate.store.results import Saved

if TYPE_CHECKING:
    from dopt.result import Assessment, TrialResult

LEASE_SECONDS = 60.0
PATIENCE_SECONDS = 30.0


def make_backend(
    url: URL, lease_seconds: float = LEASE_SECONDS, patience: float = PATIENCE_SECONDS
) -> Backend:
    """Return the backend of a database, without checking or creating anything in it."""
    if url.get_backend_name() == "sqlite":
        return SQLiteBackend(url, patience)
    return PostgreSQLBackend(url, lease_seconds, patience)


class Store:
    """Writable results database; every method is one atomic transaction.

    Every method raises ``StoreUnavailableError`` if the database fails.
    """

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    @classmethod
    def open(
        cls, url: str, lease_seconds: float = LEASE_SECONDS, patience: float = PATIENCE_SECONDS
    ) -> Self:
        """Open a database; create it where nothing is yet.

        ``lease_seconds`` is the time after its last heartbeat for which a launch on PostgreSQL is
        alive; on SQLite a file lock decides. ``patience`` bounds the wait for a lock of another
        process [s]. Raises ``SchemaVersionError`` for another version.
        """
        backend = make_backend(parse_url(url), lease_seconds, patience)
        try:
            with backend.creation() as connection:
                schema.create_or_check(connection, backend.safe_url)
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

    def begin_launch(self, record: LaunchRecord) -> int:
        """Insert a launch that starts now and return its number."""
        token = self._backend.token()
        try:
            with self._backend.transaction() as connection:
                return launches.begin(connection, self._backend, record, token)
        except BaseException:
            self._backend.forget(token)
            raise

    def end_launch(self, launch: int, state: str, exit_code: int | None = None) -> None:
        """End a launch as "done", "failed", "interrupted" or "lost" and release its claims."""
        with self._backend.transaction() as connection:
            token = launches.end(connection, launch, state, exit_code)
        self._backend.forget(token)

    def heartbeat(self, launch: int) -> None:
        """Renew the lease of the launch; on PostgreSQL, call it several times in a lease."""
        with self._backend.transaction() as connection:
            launches.renew(connection, self._backend, launch)

    def recover(self) -> int:
        """Put the trials of dead launches back to pending; return their number."""
        self._backend.evict()
        with self._backend.transaction() as connection:
            freed, tokens = launches.recover(connection, self._backend)
        for token in tokens:
            self._backend.forget(token)
        return freed

    def register(self, launch: int, specs: Iterable[Registrable]) -> Registration:
        """Register a grid and return the state of its trials; repeated calls are harmless."""
        grid = launches.GridRows(specs)
        with self._backend.transaction() as connection:
            return launches.register(connection, self._backend, launch, grid)

    def final_losses(self, trial_keys: Sequence[str]) -> dict[str, float]:
        """Return the final loss of each given trial that is done and did not diverge."""
        with self._backend.transaction() as connection:
            return final_losses(connection, self._backend, trial_keys)

    def open_configs(self, launch: int) -> list[OpenConfig]:
        """Return the configurations that have trials without an outcome.

        Only trials count that a launch with the fingerprint of this one has registered.
        """
        with self._backend.transaction() as connection:
            return launches.open_configs(connection, launch)

    def others(self, launch: int) -> list[tuple[dict[str, str] | None, int]]:
        """Return the other fingerprints with which open trials were registered, and their counts.

        None is the fingerprint of a program that stored none.
        """
        with self._backend.transaction() as connection:
            return launches.others(connection, launch)

    def open_trials(self, launch: int, config_id: int, size: int, losses: int) -> list[OpenTrial]:
        """Return some pending trials of a configuration that lost fewer launches than ``losses``.

        A launch with the fingerprint of this one has registered them. They come in a random order,
        so that workers rarely choose the same ones.
        """
        with self._backend.transaction() as connection:
            return launches.open_trials(connection, launch, config_id, size, losses)

    def suspects(self, launch: int, losses: int) -> list[OpenTrial]:
        """Return the pending trials, as above, whose launch was lost at least ``losses`` times."""
        with self._backend.transaction() as connection:
            return launches.suspects(connection, launch, losses)

    def claim(self, launch: int, trial_keys: Sequence[str], *, alike: bool = False) -> list[Claim]:
        """Claim the pending ones of the trials, in the given order.

        ``alike`` leaves out what code with another fingerprint has registered.
        """
        with self._backend.transaction() as connection:
            launches.renew(connection, self._backend, launch)
            return launches.claim(connection, self._backend, launch, trial_keys, alike)

    def commit(self, claim: Claim, result: TrialResult, run: RunRecord) -> bool:
        """Write a finished trial with its curve and trajectory; return False if the claim is lost.

        Raises ``InvalidResultError``, and writes nothing, for an invalid result.
        """
        return self.commit_many([(claim, result, run)])[0]

    def commit_many(self, items: Sequence[tuple[Claim, TrialResult, RunRecord]]) -> list[bool]:
        """Write finished trials in one transaction; return False for each lost claim.

        Raises ``InvalidResultError``, and writes nothing, if one result is invalid.
        """
        prepared = [results.prepare(*item) for item in items]
        written = [False] * len(prepared)
        # All launches use one order, which avoids deadlocks.
        order = sorted(range(len(prepared)), key=lambda i: prepared[i].claim.trial_id)
        with self._backend.transaction() as connection:
            for i in order:
                written[i] = results.write(connection, self._backend, prepared[i])
        return written

    def holds_more(self, spec: Registrable, result: TrialResult) -> bool:
        """Return whether more steps of an exploration are stored; raises as :meth:`save`."""
        with self._backend.transaction() as connection:
            return results.is_longer(connection, self._backend, spec, result)

    def save(
        self,
        launch: int,
        spec: Registrable,
        result: TrialResult,
        run: RunRecord,
        last: Saved | None = None,
    ) -> Saved | None:
        """Write an exploration as it is now, in place of what was stored of it.

        ``last`` is what the last save of this launch has returned; with it the new steps are
        appended. Returns None, and writes nothing, if more steps of it are stored. Raises
        ``StoreError`` for another exploration of the same key, and ``InvalidResultError``.
        """
        self.check()
        with self._backend.transaction() as connection:
            return results.save(connection, self._backend, launch, spec, result, run, last)

    def fail(self, claim: Claim, failure: Failure, run: RunRecord) -> bool:
        """Write a failed trial with its error; return False if the claim is lost."""
        with self._backend.transaction() as connection:
            return results.write_failure(connection, claim, failure, run)

    def add_assessments(self, measured: Mapping[str, Assessment]) -> int:
        """Write a measure of trials that are done, by trial key, and return their number.

        It takes the place of a stored value of the same step. Other trials are left as they are.
        """
        self.check()
        with self._backend.transaction() as connection:
            return results.add_assessments(connection, self._backend, measured)

    def written(self, claims: Sequence[Claim]) -> list[bool]:
        """Return for each claim whether its attempt has an outcome."""
        with self._backend.transaction() as connection:
            return [results.is_written(connection, claim) for claim in claims]

    def release(
        self, launch: int, trial_keys: Sequence[str] | None = None, cause: str | None = None
    ) -> int:
        """Put running trials of the launch, all or those given, back to pending; count them.

        ``cause`` is recorded in their attempts.
        """
        only = None if trial_keys is None else self._backend.members(trial_keys)
        with self._backend.transaction() as connection:
            return launches.free_claims(connection, [launch], "released", only, cause)

    def retry(self, status: str = "failed", trial_keys: Sequence[str] | None = None) -> int:
        """Put finished trials of a status back to pending and return their number.

        ``status`` is "failed", "diverged", "cancelled" or "all" of these; ``trial_keys`` restricts
        them to a grid. The rows of a diverged trial are deleted.
        """
        with self._backend.transaction() as connection:
            return launches.retry(connection, self._backend, status, trial_keys)

    def prune(self, trial_keys: Sequence[str]) -> int:
        """Delete the trials that have an outcome, and return their number.

        Trials of a living launch stay. The trials are deleted in several transactions, so that
        launches wait for none of them long; one that was interrupted can be repeated.
        """
        deleted = 0
        for start in range(0, len(trial_keys), results.PAGE):
            with self._backend.transaction() as connection:
                page = trial_keys[start : start + results.PAGE]
                deleted += results.prune(connection, self._backend, page)
        with self._backend.transaction() as connection:
            results.prune_unused(connection, self._backend)
        return deleted

    def close(self) -> None:
        """Close connections and locks; a launch that has not ended counts as dead from now on."""
        self._backend.close()
