"""Trials of another results database come into this one: whole, once, and never over a result.

Every page of them is one transaction, and a trial is known by its key, an attempt by its launch and
time, a launch by its token: a merge that was killed is completed by another one, and one more
changes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Row

from orchestrate.store import address, sqlite
from orchestrate.store.errors import StoreError
from orchestrate.store.merge_source import Source
from orchestrate.store.merge_target import Target, add_launches
from orchestrate.store.reader import Reader
from orchestrate.store.store import Store

RESULTS = ("done", "diverged")


@dataclass(frozen=True)
class Named:
    """A trial that needs a look."""

    trial_key: str
    env: str
    policy: str
    seed: int


@dataclass
class Merged:
    """What a merge found in the other database.

    Attributes
    ----------
    added
        Trials that were brought, by status.
    identical
        Trials that both had finished, with the same numbers.
    kept
        Trials that failed or were cancelled there and have an outcome here.
    running
        Trials that a launch runs here; they were left to it.
    conflicts
        Trials that both had finished, with different numbers; those of here were kept.
    broken
        Trials that are not whole there; they were not brought.
    launches
        Launches that were not known here.
    """

    added: dict[str, int] = field(default_factory=dict)
    identical: int = 0
    kept: int = 0
    running: int = 0
    conflicts: list[Named] = field(default_factory=list)
    broken: list[Named] = field(default_factory=list)
    launches: int = 0

    @property
    def changed(self) -> bool:
        return bool(self.added or self.launches)


def merge(url: str, other_url: str) -> Merged:
    """Bring the trials with an outcome of ``other_url`` into ``url``, and what belongs to them.

    Either may be SQLite or PostgreSQL; the first is created where there is none, the other is only
    read. Raises ``StoreError`` as the opening of a store and of a reader do.
    """
    _refuse_itself(url, other_url)
    merged = Merged()
    with Reader.open(other_url) as reader, reader.moment() as moment, Store.open(url) as store:
        store.recover()
        source = Source(moment)
        with store._backend.transaction() as connection:
            store._backend.exclusive(connection)
            launches, merged.launches = add_launches(connection, source.launches())
        for page in source.pages():
            with store._backend.transaction() as connection:
                store._backend.exclusive(connection)
                target = Target(connection, store._backend, source, launches)
                found = _merge_page(target, source, page)
            _count(merged, found)
    return merged


Found = list[tuple[str, dict[str, Any]]]


def _merge_page(target: Target, source: Source, page: list[dict[str, Any]]) -> Found:
    known = target.known([row["trial_key"] for row in page])
    return [(_merge_trial(target, source, row, known.get(row["trial_key"])), row) for row in page]


def _merge_trial(target: Target, source: Source, row: dict[str, Any], here: Row[Any] | None) -> str:
    """Bring one trial if it has its place here; return what became of it."""
    finished = row["status"] in RESULTS
    if here is not None and here.status == "running":
        return "running"
    if here is not None and not finished and here.status != "pending":
        return "kept"
    curve = source.curve(row) if finished else None
    if finished and curve is None:
        return "broken"
    if curve is not None and here is not None and here.status in RESULTS:
        return "identical" if target.is_same(here, row, curve) else "conflict"
    attempts = target.new_attempts(row, here)
    if here is not None and not finished and not attempts:
        return "kept"  # it came before, and somebody here has asked for a new run since
    target.add(row, here, attempts, curve)
    return "added"


def _count(merged: Merged, found: Found) -> None:
    for fate, row in found:
        if fate == "added":
            merged.added[row["status"]] = merged.added.get(row["status"], 0) + 1
        elif fate == "conflict":
            merged.conflicts.append(_named(row))
        elif fate == "broken":
            merged.broken.append(_named(row))
        else:
            setattr(merged, fate, getattr(merged, fate) + 1)


def _named(row: Mapping[str, Any]) -> Named:
    return Named(row["trial_key"], row["env"], row["policy"], row["seed"])


def _refuse_itself(url: str, other_url: str) -> None:
    one, other = address.parse(url), address.parse(other_url)
    if one.get_backend_name() == other.get_backend_name() == "sqlite":
        same = address.sqlite_path(one) == sqlite.existing_path(other)
    else:
        same = one == other
    if same:
        raise StoreError(
            f"Both databases are {address.safe(one)}: give another one to merge into it."
        )
