"""The write side of the results database."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Self

from orchestrate.store import address, claims, launches, outcomes, registering, versioning
from orchestrate.store.backend import Backend
from orchestrate.store.opening import LEASE_SECONDS, make_backend
from orchestrate.store.records import (
    Claim,
    Failure,
    LaunchRecord,
    Registrable,
    Registration,
    Result,
    RunRecord,
)


class Store:
    """A results database to write to; every method is one transaction, whole or not at all.

    Every method raises ``StoreUnavailableError`` where the database itself fails.
    """

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    @classmethod
    def open(cls, url: str, lease_seconds: float = LEASE_SECONDS) -> Self:
        """Open a database, and create it where there is none.

        ``lease_seconds`` is how long a launch on PostgreSQL counts as alive after a sign of life;
        on SQLite the kernel knows. Raises ``SchemaVersionError`` for a database of another version.
        """
        backend = make_backend(address.parse(url), lease_seconds)
        try:
            with backend.creation() as connection:
                versioning.create_or_check(connection, backend.safe_url)
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

    def begin_launch(self, record: LaunchRecord) -> int:
        """Write down a command that starts now and return its number."""
        with self._backend.transaction() as connection:
            return launches.begin(connection, self._backend, record)

    def end_launch(self, launch: int, state: str, exit_code: int | None = None) -> None:
        """End a launch as "done", "failed", "interrupted" or "lost" and free its last claims."""
        with self._backend.transaction() as connection:
            token = launches.end(connection, launch, state, exit_code)
        self._backend.let_go(token)

    def heartbeat(self, launch: int) -> None:
        """Show that the launch lives; on PostgreSQL, call it several times a lease."""
        with self._backend.transaction() as connection:
            launches.renew(connection, self._backend, launch)

    def recover(self) -> int:
        """Put the trials of dead launches back to pending; return how many there were."""
        self._backend.evict()
        with self._backend.transaction() as connection:
            freed, tokens = launches.recover(connection, self._backend)
        for token in tokens:
            self._backend.let_go(token)
        return freed

    def register(self, launch: int, specs: Iterable[Registrable]) -> Registration:
        """Write down a grid and return the state of each of its trials; again is harmless."""
        grid = registering.Grid(specs)
        with self._backend.transaction() as connection:
            return registering.register(connection, self._backend, launch, grid)

    def claim(self, launch: int, trial_keys: Sequence[str]) -> list[Claim]:
        """Take those of the trials that are pending, in the given order, and no others."""
        with self._backend.transaction() as connection:
            launches.renew(connection, self._backend, launch)
            return claims.claim(connection, self._backend, launch, trial_keys)

    def commit(self, claim: Claim, result: Result, run: RunRecord) -> bool:
        """Write a finished trial, summary, curve and trajectory; False where the claim is lost.

        Raises ``InvalidResultError``, with nothing written, where the result is malformed.
        """
        return self.commit_many([(claim, result, run)])[0]

    def commit_many(self, items: Sequence[tuple[Claim, Result, RunRecord]]) -> list[bool]:
        """Write finished trials in one transaction; False for each whose claim is lost.

        Raises ``InvalidResultError``, with nothing written, where one result is malformed.
        """
        prepared = [outcomes.prepare(*item) for item in items]
        written = [False] * len(prepared)
        # In one order for all launches, so that no two wait for each other's rows.
        order = sorted(range(len(prepared)), key=lambda i: prepared[i].claim.trial_id)
        with self._backend.transaction() as connection:
            for i in order:
                written[i] = outcomes.write(connection, self._backend, prepared[i])
        return written

    def fail(self, claim: Claim, failure: Failure, run: RunRecord) -> bool:
        """Write a failed trial with its error; False where the claim is lost."""
        with self._backend.transaction() as connection:
            return outcomes.write_failure(connection, claim, failure, run)

    def written(self, claims: Sequence[Claim]) -> list[bool]:
        """Tell of each claim whether its attempt has its outcome, as after a lost answer."""
        with self._backend.transaction() as connection:
            return [outcomes.is_written(connection, claim) for claim in claims]

    def release(
        self, launch: int, trial_keys: Sequence[str] | None = None, cause: str | None = None
    ) -> int:
        """Put running trials of the launch, all or those given, back to pending; count them.

        ``cause`` says what ended their attempts, where something did.
        """
        only = None if trial_keys is None else self._backend.members(trial_keys)
        with self._backend.transaction() as connection:
            return claims.free_claims(connection, [launch], "released", only, cause)

    def retry(self, status: str = "failed", trial_keys: Sequence[str] | None = None) -> int:
        """Put finished trials of a status back to pending and return how many.

        ``status`` is "failed", "diverged", "cancelled" or "all" of these; ``trial_keys`` narrows it
        to a grid. What a diverged trial had written is deleted.
        """
        with self._backend.transaction() as connection:
            return claims.retry(connection, self._backend, status, trial_keys)

    def close(self) -> None:
        """Give everything back; a launch that has not ended counts as dead from here on."""
        self._backend.close()
