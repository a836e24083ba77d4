"""Launches with their provenance and liveness."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, select

from orchestrate.store.backends.base import LaunchLife
from orchestrate.store.read.rows import LaunchRow
from orchestrate.store.schema import launch
from orchestrate.store.serialization import stored_json

Dead = Callable[[Connection, Sequence[LaunchLife]], list[LaunchLife]]

_ROWS = select(launch).order_by(launch.c.launch_id)


def launches(connection: Connection, dead: Dead) -> list[LaunchRow]:
    """Return all launches, the oldest first; ``dead`` selects the dead ones among the running."""
    rows = [row._asdict() for row in connection.execute(_ROWS)]
    running = [
        LaunchLife(row["launch_id"], row["token"], row["lease_until"])
        for row in rows
        if row["state"] == "running"
    ]
    gone = {one.launch_id for one in dead(connection, running)}
    alive = {one.launch_id for one in running} - gone
    return [_row(row, row["launch_id"] in alive) for row in rows]


def _row(row: Mapping[str, Any], alive: bool) -> LaunchRow:
    dirty = row["git_dirty"]
    return LaunchRow(
        launch_id=row["launch_id"],
        state=row["state"],
        alive=alive,
        started=row["started"],
        ended=row["ended"],
        host=row["host"],
        pid=row["pid"],
        argv=stored_json(row["argv"], list),
        overrides=stored_json(row["overrides"], list),
        git_commit=row["git_commit"],
        git_dirty=None if dirty is None else bool(dirty),
        git_diff_hash=row["git_diff_hash"],
        versions=stored_json(row["versions"], dict),
        fingerprint=row["fingerprint"] and stored_json(row["fingerprint"], dict),
    )
