"""Registration of a grid: its configurations and trials are inserted before any trial runs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

from sqlalchemy import Connection, insert, or_, select, update

from orchestrate.store.backends.base import Backend, NewTrial
from orchestrate.store.records import Registrable, Registration
from orchestrate.store.schema import CONFIG_COLUMNS, FINISHED, PREQUENTIAL, alike, config, trial
from orchestrate.store.serialization import plain

_BATCH_ROWS = 10_000


class GridRows:
    """Distinct trials of a grid, as rows of the database."""

    def __init__(self, specs: Iterable[Registrable]) -> None:
        self.trials: dict[str, tuple[str, int]] = {}  # trial_key -> config_key, seed
        self.configs: dict[str, dict[str, Any]] = {}
        for spec in specs:
            self._add(spec)

    def _add(self, spec: Registrable) -> None:
        config_key = spec.config_key
        known = self.configs.get(config_key)
        if known is None:
            known = self.configs[config_key] = _config_row(spec)
        # The string of the row is shared by all trials of the configuration.
        self.trials.setdefault(spec.trial_key, (known["config_key"], int(plain(spec.seed))))


def _config_row(spec: Registrable) -> dict[str, Any]:
    columns = spec.columns()
    if set(columns) != set(CONFIG_COLUMNS):
        raise ValueError(
            f"A configuration has the columns {', '.join(columns)}: "
            f"expected {', '.join(CONFIG_COLUMNS)}."
        )
    if PREQUENTIAL.strip("%") not in spec.config_json:  # what was measured is not run again
        from dopt.declare.registry import check_importable  # loaded with the specifications

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
    config_ids = _insert_configs(connection, backend, grid.configs, before)
    found: dict[str, tuple[str, int | None]] = {}
    for keys in _chunks(grid.trials):
        # A configuration that was not there has no trials.
        old = [key for key in keys if grid.trials[key][0] in before]
        known = _known_trials(connection, backend, old) if old else {}
        new = [key for key in keys if key not in known]
        _take_over(connection, backend, launch_id, list(known))
        _insert_trials(connection, backend, grid, new, config_ids, launch_id)
        found.update({key: known.get(key, ("pending", None)) for key in keys})
    return _summary(found, launch_id)


def _insert_configs(
    connection: Connection,
    backend: Backend,
    configs: Mapping[str, dict[str, Any]],
    known: Mapping[str, int],
) -> Mapping[str, int]:
    rows = [row for key, row in configs.items() if key not in known]
    if not rows:
        return known
    connection.execute(insert(config), rows)
    return _config_ids(connection, backend, list(configs))


def _config_ids(connection: Connection, backend: Backend, keys: Sequence[str]) -> dict[str, int]:
    statement = select(config.c.config_key, config.c.config_id).where(
        config.c.config_key.in_(backend.members(keys))
    )
    return {row[0]: row[1] for row in connection.execute(statement)}


def _known_trials(
    connection: Connection, backend: Backend, keys: Sequence[str]
) -> dict[str, tuple[str, int | None]]:
    statement = select(trial.c.trial_key, trial.c.status, trial.c.owner).where(
        trial.c.trial_key.in_(backend.members(keys))
    )
    return {key: (status, owner) for key, status, owner in connection.execute(statement)}


def _take_over(
    connection: Connection, backend: Backend, launch_id: int, keys: Sequence[str]
) -> None:
    """Let workers with the code of this launch run trials that other code has registered."""
    if not keys:
        return
    ours = trial.c.registered_by.in_(alike(launch_id))
    others = (
        select(trial.c.trial_id)
        .where(trial.c.trial_key.in_(backend.members(keys)))
        .where(trial.c.status.not_in(("running", *FINISHED)))
        .where(or_(trial.c.registered_by.is_(None), ~ours))
        .with_for_update(skip_locked=True)
    )
    taken = update(trial).where(trial.c.trial_id.in_(others))
    connection.execute(taken.values(registered_by=launch_id))


def _insert_trials(
    connection: Connection,
    backend: Backend,
    grid: GridRows,
    keys: Sequence[str],
    config_ids: Mapping[str, int],
    launch_id: int,
) -> None:
    placed = ((key, *grid.trials[key]) for key in keys)
    trials = [NewTrial(key, config_ids[config_key], seed) for key, config_key, seed in placed]
    if trials:
        backend.insert_trials(connection, trials, launch_id)


def _summary(found: Mapping[str, tuple[str, int | None]], launch_id: int) -> Registration:
    counts = dict.fromkeys(("done", "diverged", "failed", "cancelled"), 0)
    elsewhere = 0
    todo = []
    for key, (status, owner) in found.items():
        if status in counts:
            counts[status] += 1
        elif status == "running" and owner != launch_id:
            elsewhere += 1
        else:
            todo.append(key)
    return Registration(total=len(found), **counts, running_elsewhere=elsewhere, todo=todo)


def _chunks(keys: Iterable[str]) -> Iterator[list[str]]:
    iterator = iter(keys)
    while chunk := list(islice(iterator, _BATCH_ROWS)):
        yield chunk
