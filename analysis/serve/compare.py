"""The reference policy against every baseline: the sheets of ``analysis compare`` as a page."""

from __future__ import annotations

import math
from typing import Any

import pandas as pd

from analysis.divergence import DivergenceRule
from analysis.errors import AnalysisError
from analysis.measures import Measure
from analysis.request import Request
from analysis.selection import Selection
from analysis.serve.asked import Asked
from analysis.serve.curves import COLUMNS, by_environment, notes, width_text, widths
from analysis.serve.naming import look
from analysis.serve.progress import measure
from analysis.serve.site import Site
from analysis.tables import TableKind, comparison
from orchestrate.store import Reader

FURTHEST = 10.0
"""Ratio at the edge of the little chart beside each row."""

WIDTH = 170
"""Width of that chart [pixels]."""

MEASURES = {
    Measure.FINAL: "final loss",
    Measure.AUC: "whole curve",
    Measure.STEPS: "steps to a loss",
}


def compare(site: Site, asked: Asked) -> dict[str, Any]:
    """Return the comparison as a person reads it, and the numbers behind it."""
    reader = site.source.reader()
    stored = by_environment(reader)
    env = asked.one_of("env", stored)
    selection = site.select(reader, asked.wanted(*([env] if env else [])))
    kind, request = _kind(asked)
    found = _measured(site, reader, selection, asked)
    sheet = kind.sheet(found, request)
    return {
        "progress": measure(reader),
        "title": kind.title,
        "headers": list(sheet.headers),
        "rows": [list(row) for row in sheet.rows],
        "note": sheet.note,
        "numbers": records(found),
        "forest": forest(records(found)),
        "looks": {name: look(name) for name in selection.policies},
        "missing": sum(len(gap.seeds) for gap in selection.gaps),
        "widths": width_text(selection),
        "notes": notes(selection),
        "options": _options(stored),
    }


def table(site: Site, asked: Asked) -> pd.DataFrame:
    """Return the numbers as a table, in the columns of the CSV of ``analysis compare``."""
    reader = site.source.reader()
    env = asked.one_of("env", by_environment(reader))
    selection = site.select(reader, asked.wanted(*([env] if env else [])))
    return _measured(site, reader, selection, asked)


def _kind(asked: Asked) -> tuple[TableKind, Request]:
    column = asked.one_of("column", COLUMNS, "loss")
    kind = comparison(column, asked.member("measure", Measure, Measure.FINAL))
    return kind, Request(asked.member("diverged", DivergenceRule, DivergenceRule.EXCLUDE))


def _measured(site: Site, reader: Reader, selection: Selection, asked: Asked) -> pd.DataFrame:
    kind, request = _kind(asked)
    part = kind.part(selection)
    if not part.entries:
        raise AnalysisError(
            "A comparison needs finished trials of D-optimal and of a baseline in one "
            "environment, but none are stored: wait for the launch, or ask wider."
        )
    key = ("compare", reader, part.fingerprint(), kind.title, request)
    return site.memory.recall(key, lambda: kind.measure(reader, part, request))


def records(found: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as mappings."""
    return [{str(name): value for name, value in row.items()} for row in found.to_dict("records")]


def forest(rows: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Return where ratios and their intervals lie on a common logarithmic axis [pixels].

    Beyond a factor of FURTHEST an interval ends at the edge; ``beyond`` is an arrow in place of one
    that lies there whole. None where the table has no ratios.
    """
    if not rows or not {"ratio", "low", "high"} <= set(rows[0]):
        return None

    def place(value: float) -> float:
        share = math.log(value) / math.log(FURTHEST)
        return round(WIDTH / 2 * (1 + max(-1.0, min(1.0, share)) * 0.94), 1)

    return {
        "one": place(1.0),
        "rows": [
            {name: place(row[name]) for name in ("low", "ratio", "high")} | {"beyond": _beyond(row)}
            if all(row[name] > 0 for name in ("low", "ratio", "high"))
            else None
            for row in rows
        ],
    }


def _beyond(row: dict[str, Any]) -> str | None:
    """Return the outline of an arrow at the edge where the whole interval lies beyond it."""
    if row["low"] > FURTHEST:
        return f"M{WIDTH - 10} 5l8 5l-8 5z"
    return "M10 5l-8 5l8 5z" if row["high"] < 1 / FURTHEST else None


def _options(stored: dict[str, Any]) -> dict[str, Any]:
    return {
        "env": list(stored),
        "measure": MEASURES,
        "column": COLUMNS,
        "width": widths([cell for cells in stored.values() for cell in cells]),
        "diverged": list(DivergenceRule),
    }
