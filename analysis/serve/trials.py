"""Trials page: filtered and sorted list with keyset pagination."""

from __future__ import annotations

from typing import Any

from analysis.data.trial_selection import environment_rank, policy_rank
from analysis.serve.curves import widths
from analysis.serve.policy_labels import legend_entry
from analysis.serve.progress import read_progress
from analysis.serve.query_params import QueryParams
from analysis.serve.state import ServerState
from analysis.serve.trial_columns import (
    COLUMNS,
    NOT_COMPUTED,
    NUMBERS,
    TEXTS,
    computed_columns,
    shown_columns,
)
from analysis.serve.trial_query import Condition, count, position_of, read_page
from orchestrate.store import ConfigRow

STATUSES = ("done", "diverged", "failed", "cancelled", "running", "pending")
SIZES = ("25", "50", "100", "200")


def trials(state: ServerState, params: QueryParams) -> dict[str, Any]:
    """Return one page of the list, the number of matches, and where adjacent pages start."""
    reader = state.database.reader()
    configs = reader.configs()
    conditions = _filters(params, configs)
    sort = params.choice("sort", COLUMNS, "env")
    descending = params.choice("order", ("asc", "desc"), "asc") == "desc"
    size = int(params.choice("size", SIZES, "50"))
    after, before = (params.position(name, text=sort in TEXTS) for name in ("after", "before"))
    backwards = before is not None and after is None
    rows = read_page(
        reader, COLUMNS, conditions, sort, descending, after or before, backwards, size + 1
    )
    further = len(rows) > size  # in the direction of the walk; back there is where it came from
    rows = rows[1:] if backwards and further else rows[:size]
    came = after is not None or before is not None
    earlier, later = (further, came) if backwards else (came, further)
    total = count(reader, conditions)
    matching = _matching(params, configs)
    computed = computed_columns(matching)
    for row in rows:
        row |= computed.get(row["config_key"], NOT_COMPUTED)
    return {
        "progress": read_progress(reader),
        "rows": rows,
        "total": total,
        "sort": sort,
        "order": "desc" if descending else "asc",
        "previous": position_of(rows[0], sort) if rows and earlier else None,
        "next": position_of(rows[-1], sort) if rows and later else None,
        "columns": shown_columns(matching, computed, sort),
        "sortable": list(COLUMNS),
        "numbers": NUMBERS,
        "legend": {name: legend_entry(name) for name in _policies(configs)},
        "options": _options(configs),
    }


def _matching(params: QueryParams, configs: list[ConfigRow]) -> list[ConfigRow]:
    """Return the configurations that the filters allow."""
    key, width = params.text("config"), params.integer("width", low=1)
    env, policy = params.text("env"), params.text("policy")
    return [
        config
        for config in configs
        if config.env == (env or config.env)
        and config.policy == (policy or config.policy)
        and config.config_key == (key or config.config_key)
        and config.width == (width or config.width)
    ]


def _filters(params: QueryParams, configs: list[ConfigRow]) -> list[Condition]:
    given = {
        "env": params.choice("env", {config.env for config in configs}),
        "policy": params.choice("policy", {config.policy for config in configs}),
        "status": params.choice("status", STATUSES),
        "config_key": params.text("config"),
        "width": params.integer("width", low=1),
        "seed": params.integer("seed", high=2**63 - 1),
        "launch_id": params.integer("launch"),
    }
    return [
        Condition(f"{column} = :{column}", {column: value})
        for column, value in given.items()
        if value not in ("", None)
    ]


def _policies(configs: list[ConfigRow]) -> list[str]:
    return sorted({config.policy for config in configs}, key=policy_rank)


def _options(configs: list[ConfigRow]) -> dict[str, Any]:
    return {
        "env": sorted({config.env for config in configs}, key=environment_rank),
        "policy": {name: legend_entry(name)["label"] for name in _policies(configs)},
        "width": widths(configs),
        "status": STATUSES,
        "size": SIZES,
    }
