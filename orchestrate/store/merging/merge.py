"""Merge of another results database into this one, without overwriting any result.

Each page of trials is one transaction. A trial is identified by its key, an attempt by its launch
and time, a launch by its token, so that a merge that was killed can be repeated, and repeating a
finished merge changes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Row

from orchestrate.store import database_url
from orchestrate.store.backends import sqlite
from orchestrate.store.doctor import TrialKey
from orchestrate.store.errors import StoreError
from orchestrate.store.merging.source import Page, Source
from orchestrate.store.merging.target import Target, add_launches
from orchestrate.store.read.reader import Reader
from orchestrate.store.schema import FINISHED
from orchestrate.store.store import Store


@dataclass(frozen=True)
class TrialName:
    """Trial with a conflict or with missing rows."""

    trial_key: str
    env: str
    policy: str
    seed: int


@dataclass
class Merged:
    """Result of a merge.

    Attributes
    ----------
    added
        Copied trials, by status.
    identical
        Trials finished in both databases with equal numbers.
    kept
        Trials that failed or were cancelled there and have an outcome here, and explorations that
        have more steps here.
    running
        Trials that a launch is running here, which were not copied.
    conflicts
        Trials finished in both databases with different numbers, which were not copied.
    incomplete
        Trials with missing rows there, which were not copied.
    contradictory
        Trials there whose key is not that of their configuration and seed, or whose arrays have
        other shapes than they say, which were not copied.
    launches
        New launches.
    """

    added: dict[str, int] = field(default_factory=dict)
    identical: int = 0
    kept: int = 0
    running: int = 0
    conflicts: list[TrialName] = field(default_factory=list)
    incomplete: list[TrialName] = field(default_factory=list)
    contradictory: list[TrialName] = field(default_factory=list)
    launches: int = 0

    def include(self, other: Merged) -> None:
        """Add the counts of one more merge into the same database."""
        for status, count in other.added.items():
            self.added[status] = self.added.get(status, 0) + count
        for name in vars(self).keys() - {"added"}:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def changed(self) -> bool:
        return bool(self.added or self.launches)


def merge(url: str, other_url: str, trial_key: TrialKey | None = None) -> Merged:
    """Bring the trials with an outcome of ``other_url`` into ``url``, and what belongs to them.

    Either may be SQLite or PostgreSQL; the first is created where there is none, the other is only
    read. ``trial_key`` is as in :func:`orchestrate.store.examine`. Raises ``StoreError`` as the
    opening of a store and of a reader do.
    """
    _refuse_itself(url, other_url)
    merged = Merged()
    with Reader.open(other_url) as reader, reader.moment() as moment, Store.open(url) as store:
        store.recover()
        source = Source(moment, trial_key)
        with store._backend.transaction() as connection:
            store._backend.exclusive(connection)
            launches, merged.launches = add_launches(connection, source.launches())
        for page in source.pages():
            with store._backend.transaction() as connection:
                store._backend.exclusive(connection)
                target = Target(connection, store._backend, source, launches)
                found = _merge_page(target, page)
            _count(merged, found)
    return merged


Found = list[tuple[str, dict[str, Any]]]


def _merge_page(target: Target, page: Page) -> Found:
    known = target.known([row["trial_key"] for row in page.trials])
    found = [
        (_merge_trial(target, page, row, known.get(row["trial_key"])), row) for row in page.trials
    ]
    target.write()
    return found


def _merge_trial(target: Target, page: Page, row: dict[str, Any], here: Row[Any] | None) -> str:
    """Copy one trial if it is new here; return the outcome as a field of :class:`Merged`."""
    if row["trial_id"] in page.contradictory:
        return "contradictory"
    finished = row["status"] in FINISHED
    if here is not None and here.status == "running":
        return "running"
    if here is not None and not finished and here.status != "pending":
        return "kept"
    curve = page.curves.get(row["trial_id"])
    if finished and curve is None:
        return "incomplete"
    if curve is not None and here is not None and here.status in FINISHED:
        if target.is_same(here, row, curve):
            return "identical"
        ahead = target.steps_ahead(here, curve) if row["grows"] else None
        if ahead is None or ahead == 0:
            return "conflict"
        if ahead > 0:
            return "kept"
        target.clear(here)
    attempts = target.new_attempts(page.attempts[row["trial_id"]], here)
    if here is not None and row["status"] != "done" and not attempts:
        return "kept"  # it was merged before, and a new run was requested here since
    target.add(row, here, attempts, curve)
    return "added"


def _count(merged: Merged, found: Found) -> None:
    for fate, row in found:
        if fate == "added":
            merged.added[row["status"]] = merged.added.get(row["status"], 0) + 1
        elif fate == "conflict":
            merged.conflicts.append(_named(row))
        elif fate in ("incomplete", "contradictory"):
            getattr(merged, fate).append(_named(row))
        else:
            setattr(merged, fate, getattr(merged, fate) + 1)


def _named(row: Mapping[str, Any]) -> TrialName:
    return TrialName(row["trial_key"], row["env"], row["policy"], row["seed"])


def _refuse_itself(url: str, other_url: str) -> None:
    one, other = database_url.parse(url), database_url.parse(other_url)
    if one.get_backend_name() == other.get_backend_name() == "sqlite":
        same = database_url.sqlite_path(one) == sqlite.existing_path(other)
    else:
        same = one == other
    if same:
        raise StoreError(
            f"Both databases are {database_url.safe(one)}: give another one to merge into it."
        )
