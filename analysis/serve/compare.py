"""Compare page: the tables of ``analysis compare`` with an interval plot in each row."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from analysis.data.config_matching import REFERENCE
from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import Selection, policy_rank
from analysis.errors import AnalysisError
from analysis.plot_options import PlotOptions
from analysis.serve.curves import COLUMNS, by_environment, notes, width_text, widths
from analysis.serve.policy_labels import legend_entry
from analysis.serve.progress import read_progress
from analysis.serve.query_params import QueryParams
from analysis.serve.state import ServerState
from analysis.stats.trial_scores import Measure
from analysis.tables.registry import TableKind, comparison
from orchestrate.store import ConfigRow, Reader

LARGEST_RATIO = 10.0
"""Ratio at the edge of the interval plot in each row."""

WIDTH = 170
"""Width of the interval plot [pixels]."""

MEASURES = {
    Measure.FINAL: "final loss",
    Measure.AUC: "whole curve",
    Measure.STEPS: "steps to a loss",
}


def compare(state: ServerState, params: QueryParams) -> dict[str, Any]:
    """Return the comparison table as text and its numbers."""
    reader = state.database.reader()
    stored = by_environment(reader)
    policies = _policies(stored)
    selection = _selected(state, reader, params, stored)
    kind, request = _kind(params)
    found = _measured(state, reader, selection, params)
    sheet = kind.render(found, request)
    return {
        "progress": read_progress(reader),
        "title": kind.title,
        "headers": list(sheet.headers),
        "rows": [list(row) for row in sheet.rows],
        "note": sheet.note,
        "numbers": records(found),
        "forest": forest_plot(records(found)),
        "variants": [_variant(row) for row in records(found)],
        "reference": selection.reference,
        "missing": sum(len(gap.seeds) for gap in selection.gaps),
        "widths": width_text(selection),
        "notes": notes(selection),
        "options": _options(stored, policies),
    }


def table(state: ServerState, params: QueryParams) -> pd.DataFrame:
    """Return the numbers as a table, in the columns of the CSV of ``analysis compare``."""
    reader = state.database.reader()
    selection = _selected(state, reader, params, by_environment(reader))
    return _measured(state, reader, selection, params)


def _policies(stored: Mapping[str, Sequence[ConfigRow]]) -> list[str]:
    """Return the stored policies in the order of legends."""
    return sorted(
        {config.policy for configs in stored.values() for config in configs}, key=policy_rank
    )


def _selected(
    state: ServerState,
    reader: Reader,
    params: QueryParams,
    stored: Mapping[str, Sequence[ConfigRow]],
) -> Selection:
    """Return the trials that the parameters select, with the reference policy."""
    env = params.choice("env", stored)
    policies = _policies(stored)
    reference = params.choice("reference", policies, REFERENCE if REFERENCE in policies else "")
    wanted = params.filter(*([env] if env else []))
    return state.select(reader, replace(wanted, reference=reference or REFERENCE))


def _variant(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the legend entry of a row: the line of its policy with the variant's label."""
    return legend_entry(row["policy"]) | {"label": row["variant"]}


def _kind(params: QueryParams) -> tuple[TableKind, PlotOptions]:
    column = params.choice("column", COLUMNS, "loss")
    kind = comparison(column, params.member("measure", Measure, Measure.FINAL))
    return kind, PlotOptions(params.member("diverged", DivergenceRule, DivergenceRule.EXCLUDE))


def _measured(
    state: ServerState, reader: Reader, selection: Selection, params: QueryParams
) -> pd.DataFrame:
    kind, request = _kind(params)
    part = kind.part(selection)
    if not part.entries:
        raise AnalysisError(
            "A comparison needs finished trials of D-optimal and of a baseline in one "
            "environment, but none are stored: wait for the launch, or remove a condition."
        )
    key = ("compare", reader, part.fingerprint(), kind.title, request)
    return state.cache.get_or_compute(key, lambda: kind.measure(reader, part, request))


def records(found: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as mappings."""
    return [{str(name): value for name, value in row.items()} for row in found.to_dict("records")]


def forest_plot(rows: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Return positions of ratios and their intervals on a common logarithmic axis [pixels].

    An interval ends at LARGEST_RATIO; ``beyond`` is an arrow for one that lies outside.
    None for a table without ratios.
    """
    if not rows or not {"ratio", "low", "high"} <= set(rows[0]):
        return None

    def position(value: float) -> float:
        share = math.log(value) / math.log(LARGEST_RATIO)
        return round(WIDTH / 2 * (1 + max(-1.0, min(1.0, share)) * 0.94), 1)

    return {
        "one": position(1.0),
        "rows": [
            {name: position(row[name]) for name in ("low", "ratio", "high")}
            | {"beyond": _beyond(row)}
            if all(row[name] > 0 for name in ("low", "ratio", "high"))
            else None
            for row in rows
        ],
    }


def _beyond(row: dict[str, Any]) -> str | None:
    """Return the outline of an arrow at the edge for an interval outside of the axis."""
    if row["low"] > LARGEST_RATIO:
        return f"M{WIDTH - 10} 5l8 5l-8 5z"
    return "M10 5l-8 5l8 5z" if row["high"] < 1 / LARGEST_RATIO else None


def _options(stored: dict[str, Any], policies: list[str]) -> dict[str, Any]:
    return {
        "reference": {name: legend_entry(name)["label"] for name in policies},
        "env": list(stored),
        "measure": MEASURES,
        "column": COLUMNS,
        "width": widths([config for configs in stored.values() for config in configs]),
        "diverged": list(DivergenceRule),
    }
