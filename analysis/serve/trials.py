"""Trials in a list: filtered, sorted, and paged by key, so that the last page costs the first's."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from analysis.selection import environment_rank, policy_rank
from analysis.serve.asked import Asked
from analysis.serve.curves import widths
from analysis.serve.naming import look
from analysis.serve.progress import measure
from analysis.serve.site import Site
from orchestrate.store import Cell, Reader

COLUMNS = {
    "env": "environment",
    "policy": "policy",
    "width": "width",
    "seed": "seed",
    "status": "status",
    "final_loss": "final loss",
    "best_loss": "best loss",
    "diverged_at": "diverged at",
    "wall_seconds": "wall time",
    "attempt": "attempts",
    "node": "node",
    "error_type": "error",
}
"""Columns of the list with their headings; it can be sorted by each."""

TEXTS = ("env", "policy", "status", "node", "error_type")
"""Columns that hold texts; the others hold numbers."""

STATUSES = ("done", "diverged", "failed", "cancelled", "running", "pending")
SIZES = ("25", "50", "100", "200")


@dataclass(frozen=True)
class Condition:
    """A part of a WHERE clause with the values that are bound to it."""

    sql: str
    values: dict[str, object]


def trials(site: Site, asked: Asked) -> dict[str, Any]:
    """Return one page of the list, how many trials fit, and where its neighbours start."""
    reader = site.source.reader()
    cells = reader.cells()
    conditions = _filters(asked, cells)
    sort = asked.one_of("sort", COLUMNS, "env")
    descending = asked.one_of("order", ("asc", "desc"), "asc") == "desc"
    size = int(asked.one_of("size", SIZES, "50"))
    after, before = (asked.place(name, text=sort in TEXTS) for name in ("after", "before"))
    backwards = before is not None and after is None
    rows = _page(reader, conditions, sort, descending, after or before, backwards, size)
    total = _count(reader, conditions)
    return {
        "progress": measure(reader),
        "rows": rows,
        "total": total,
        "sort": sort,
        "order": "desc" if descending else "asc",
        "previous": _place(rows[0], sort) if rows and (after or before) else None,
        "next": _place(rows[-1], sort) if len(rows) == size else None,
        "columns": COLUMNS,
        "looks": {name: look(name) for name in _policies(cells)},
        "options": _options(cells),
    }


def _filters(asked: Asked, cells: list[Cell]) -> list[Condition]:
    given = {
        "env": asked.one_of("env", {cell.env for cell in cells}),
        "policy": asked.one_of("policy", {cell.policy for cell in cells}),
        "status": asked.one_of("status", STATUSES),
        "config_key": asked.text("config"),
        "width": asked.whole("width", low=1),
        "seed": asked.whole("seed", high=2**63 - 1),
        "launch_id": asked.whole("launch"),
    }
    return [
        Condition(f"{column} = :{column}", {column: value})
        for column, value in given.items()
        if value not in ("", None)
    ]


def _page(
    reader: Reader,
    conditions: list[Condition],
    sort: str,
    descending: bool,
    place: tuple[float | str | None, int] | None,
    backwards: bool,
    size: int,
) -> list[dict[str, Any]]:
    """Return the rows after a place, or before it; NULL sorts last, equal values by trial_id."""
    parts = list(conditions)
    if place is not None:
        parts.append(_beyond(sort, descending, place, backwards))
    last, first = ("DESC", "ASC") if backwards else ("ASC", "DESC")
    order = (
        f"CASE WHEN {sort} IS NULL THEN 1 ELSE 0 END {last}, "
        f"{sort} {first if descending else last}, trial_id {last}"
    )
    found = reader.rows(
        f"SELECT trial_id, trial_key, {', '.join(COLUMNS)} FROM v_trial {_where(parts)} "
        f"ORDER BY {order} LIMIT :size",
        **_values(parts),
        size=size,
    )
    rows = [dict(zip(found.columns, row, strict=True)) for row in found]
    return rows[::-1] if backwards else rows


def _beyond(
    sort: str, descending: bool, place: tuple[float | str | None, int], backwards: bool
) -> Condition:
    """Return the condition of the rows that come after a place, or before it."""
    value, row = place
    further = "<" if backwards else ">"
    past = "<" if descending != backwards else ">"
    if value is None:
        sql = f"({sort} IS NULL AND trial_id {further} :at_row)"
        sql = f"({sort} IS NOT NULL OR {sql})" if backwards else sql
        return Condition(sql, {"at_row": row})
    sql = f"({sort} {past} :at OR ({sort} = :at AND trial_id {further} :at_row)"
    sql += ")" if backwards else f" OR {sort} IS NULL)"
    return Condition(sql, {"at": value, "at_row": row})


def _count(reader: Reader, conditions: list[Condition]) -> int:
    sql = f"SELECT count(*) AS n FROM v_trial {_where(conditions)}"
    return int(reader.rows(sql, **_values(conditions))[0].n)


def _where(conditions: list[Condition]) -> str:
    return f"WHERE {' AND '.join(one.sql for one in conditions)}" if conditions else ""


def _values(conditions: list[Condition]) -> dict[str, object]:
    return {name: value for one in conditions for name, value in one.values.items()}


def _place(row: dict[str, Any], sort: str) -> str:
    return json.dumps([row[sort], row["trial_id"]])


def _policies(cells: list[Cell]) -> list[str]:
    return sorted({cell.policy for cell in cells}, key=policy_rank)


def _options(cells: list[Cell]) -> dict[str, Any]:
    return {
        "env": sorted({cell.env for cell in cells}, key=environment_rank),
        "policy": {name: look(name)["label"] for name in _policies(cells)},
        "width": widths(cells),
        "status": STATUSES,
        "size": SIZES,
    }
