"""Loss curves of one environment, the numbers of figure 1."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pandas as pd

from analysis.divergence import DivergenceRule
from analysis.errors import AnalysisError
from analysis.figures.axis_break import axis_parts
from analysis.loss_curves import Axis, LossCurve, measure_curves, tabulate_curves
from analysis.selection import Selection, environment_rank, newest
from analysis.serve.asked import Asked
from analysis.serve.naming import look
from analysis.serve.site import Site
from orchestrate.store import Cell, Reader

COLUMNS = ("loss", "reachable_loss")


def choices(site: Site, asked: Asked) -> dict[str, Any]:
    """Return the environments that are stored, each with its widths."""
    stored = by_environment(site.source.reader())
    return {
        "env": asked.one_of("env", stored, next(iter(stored), "")),
        "environments": [{"env": env, "widths": widths(cells)} for env, cells in stored.items()],
        "columns": COLUMNS,
        "rules": list(DivergenceRule),
    }


def by_environment(reader: Reader) -> dict[str, list[Cell]]:
    """Return the stored configurations by environment, in the paper's order."""
    cells = newest(reader.cells())
    names = sorted({cell.env for cell in cells}, key=environment_rank)
    return {env: [cell for cell in cells if cell.env == env] for env in names}


def widths(cells: list[Cell]) -> list[int]:
    """Return the widths of some configurations, ascending."""
    return sorted({cell.width for cell in cells if cell.width is not None})


def curves(site: Site, asked: Asked) -> dict[str, Any]:
    """Return the curve and the interval of every policy in one environment, and what is missing.

    ``main`` are the limits of the upper part of an axis that the figure would break, else None.
    """
    selection, found = _measured(site, asked)
    parts = axis_parts([curve.band for curve in found])
    longest = max(found, key=lambda curve: len(curve.x))
    return {
        "env": found[0].env,
        "statistic": found[0].statistic.label,
        "band": found[0].statistic.band,
        "t": longest.t,
        "x": longest.x,
        "main": parts.upper if parts.lower else None,
        "curves": [_curve(curve) for curve in found],
        "widths": width_text(selection),
        "notes": notes(selection),
        "missing": [
            {"policy": gap.policy, "states": gap.states, "seeds": gap.describe_seeds()}
            for gap in selection.gaps
        ],
    }


def table(site: Site, asked: Asked) -> pd.DataFrame:
    """Return the same as a table, in the columns of the CSV beside figure 1."""
    return tabulate_curves(_measured(site, asked)[1])


def _measured(site: Site, asked: Asked) -> tuple[Selection, tuple[LossCurve, ...]]:
    reader = site.source.reader()
    env = asked.text("env") or next(iter(by_environment(reader)), "")
    if not env:
        raise AnalysisError("The database holds no trial yet: curves appear once one has ended.")
    selection = site.select(reader, asked.wanted(env))
    column = asked.one_of("column", COLUMNS, "loss")
    rule = asked.member("diverged", DivergenceRule, DivergenceRule.EXCLUDE)
    axis = asked.member("x", Axis, Axis.STEPS)
    parts = [replace(selection, entries=(entry,), gaps=()) for entry in selection.entries]

    def curve(part: Selection) -> LossCurve:
        key = ("curve", reader, part.fingerprint(), column, rule, axis)
        return site.memory.recall(
            key, lambda: _light(measure_curves(reader, part, column, rule, axis)[0])
        )

    return selection, tuple(curve(part) for part in parts)


def width_text(selection: Selection) -> str:
    """Return which width is shown, as the end of a heading; empty where it is not one."""
    found = widths([entry.cell for entry in selection.entries])
    return f", width {found[0]}" if len(found) == 1 else ""


def notes(selection: Selection) -> list[str]:
    """Return the sentences on what was left out, with the advice of a page."""
    return [
        note.replace("see --where", "choose a width or a condition") for note in selection.notes
    ]


def _light(curve: LossCurve) -> LossCurve:
    """Return a curve without the values of its trials, of which the count alone is still needed."""
    return replace(curve, sample=replace(curve.sample, values=curve.sample.values[:, :0].copy()))


def _curve(curve: LossCurve) -> dict[str, Any]:
    return {
        **look(curve.policy),
        "centre": curve.band.centre,
        "low": curve.band.low,
        "high": curve.band.high,
        "n": curve.band.n,
        "n_diverged": curve.sample.n_diverged,
        "count": curve.sample.describe(),
    }
