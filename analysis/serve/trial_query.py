"""SQL of the trials page: conditions, order and keyset pagination over ``v_trial``."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from orchestrate.store import Reader

Position = tuple[float | str | None, int]
"""Sort value and row id of a trial, after or before which a page starts."""


@dataclass(frozen=True)
class Condition:
    """A part of a WHERE clause with its bound values."""

    sql: str
    values: dict[str, object]


def read_page(
    reader: Reader,
    columns: Iterable[str],
    conditions: list[Condition],
    sort: str,
    descending: bool,
    position: Position | None,
    backwards: bool,
    size: int,
) -> list[dict[str, Any]]:
    """Return the rows after or before a position; NULL sorts last, equal values by trial_id."""
    parts = list(conditions)
    if position is not None:
        parts.append(_after_position(sort, descending, position, backwards))
    last, first = ("DESC", "ASC") if backwards else ("ASC", "DESC")
    order = (
        f"CASE WHEN {sort} IS NULL THEN 1 ELSE 0 END {last}, "
        f"{sort} {first if descending else last}, trial_id {last}"
    )
    found = reader.rows(
        f"SELECT trial_id, trial_key, config_key, {', '.join(columns)} FROM v_trial "
        f"{_where(parts)} ORDER BY {order} LIMIT :size",
        **_values(parts),
        size=size,
    )
    rows = [dict(zip(found.columns, row, strict=True)) for row in found]
    return rows[::-1] if backwards else rows


def _after_position(sort: str, descending: bool, position: Position, backwards: bool) -> Condition:
    """Return the condition of the rows after or before a position."""
    value, row = position
    further = "<" if backwards else ">"
    past = "<" if descending != backwards else ">"
    if value is None:
        sql = f"({sort} IS NULL AND trial_id {further} :at_row)"
        sql = f"({sort} IS NOT NULL OR {sql})" if backwards else sql
        return Condition(sql, {"at_row": row})
    sql = f"({sort} {past} :at OR ({sort} = :at AND trial_id {further} :at_row)"
    sql += ")" if backwards else f" OR {sort} IS NULL)"
    return Condition(sql, {"at": value, "at_row": row})


def count(reader: Reader, conditions: list[Condition]) -> int:
    sql = f"SELECT count(*) AS n FROM v_trial {_where(conditions)}"
    return int(reader.rows(sql, **_values(conditions))[0].n)


def _where(conditions: list[Condition]) -> str:
    return f"WHERE {' AND '.join(one.sql for one in conditions)}" if conditions else ""


def _values(conditions: list[Condition]) -> dict[str, object]:
    return {name: value for one in conditions for name, value in one.values.items()}


def position_of(row: dict[str, Any], sort: str) -> str:
    return json.dumps([row[sort], row["trial_id"]])
