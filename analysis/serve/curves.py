"""Curves page: loss curves of one environment with the numbers of figure 1."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from analysis.data.divergence import DivergenceRule
from analysis.data.latest_configs import latest
from analysis.data.trial_selection import Selection, environment_rank
from analysis.errors import AnalysisError
from analysis.figures.axis_break import axis_parts
from analysis.figures.loss_curves.data import Axis, LossCurve, measure_curves, tabulate_curves
from analysis.serve.policy_labels import legend_entry
from analysis.serve.query_params import QueryParams
from analysis.serve.state import ServerState
from orchestrate.store import ConfigRow, Reader

WINDOW = 25
RUNNING = f"running median of {WINDOW} steps"

COLUMNS = ("loss", "reachable_loss")


def choices(state: ServerState, params: QueryParams) -> dict[str, Any]:
    """Return the stored environments, each with its widths."""
    stored = by_environment(state.database.reader())
    return {
        "env": params.choice("env", stored, next(iter(stored), "")),
        "environments": [
            {"env": env, "widths": widths(configs)} for env, configs in stored.items()
        ],
        "columns": COLUMNS,
        "rules": list(DivergenceRule),
    }


def by_environment(reader: Reader) -> dict[str, list[ConfigRow]]:
    """Return the stored configurations by environment, in the paper's order."""
    configs = latest(reader, reader.configs())
    names = sorted({config.env for config in configs}, key=environment_rank)
    return {env: [config for config in configs if config.env == env] for env in names}


def widths(configs: list[ConfigRow]) -> list[int]:
    """Return the widths of some configurations, ascending."""
    return sorted({config.width for config in configs if config.width is not None})


def curves(state: ServerState, params: QueryParams) -> dict[str, Any]:
    """Return the curve and interval of every policy in one environment, and the missing trials.

    ``main`` holds the limits of the upper part of the axis where figure 1 has an axis break, else
    None.
    """
    selection, found = _measured(state, params)
    parts = axis_parts([curve.band for curve in found])
    longest = max(found, key=lambda curve: len(curve.x))
    return {
        "env": found[0].env,
        "is_prequential": found[0].is_prequential,
        "statistic": RUNNING if found[0].is_prequential else found[0].statistic.label,
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


def table(state: ServerState, params: QueryParams) -> pd.DataFrame:
    """Return the curves as a table with the columns of figure 1's CSV file."""
    return tabulate_curves(_measured(state, params)[1])


def _measured(state: ServerState, params: QueryParams) -> tuple[Selection, tuple[LossCurve, ...]]:
    reader = state.database.reader()
    env = params.text("env") or next(iter(by_environment(reader)), "")
    if not env:
        raise AnalysisError(
            "The database has no trials yet: curves appear when the first trial has ended."
        )
    selection = state.select(reader, params.filter(env))
    column = params.choice("column", COLUMNS, "loss")
    rule = params.member("diverged", DivergenceRule, DivergenceRule.EXCLUDE)
    axis = params.member("x", Axis, Axis.STEPS)
    parts = [replace(selection, entries=(entry,), gaps=()) for entry in selection.entries]

    def curve(part: Selection) -> LossCurve:
        key = ("curve", reader, part.fingerprint(), column, rule, axis)
        return state.cache.get_or_compute(
            key, lambda: _light(measure_curves(reader, part, column, rule, axis)[0])
        )

    return selection, tuple(curve(part) for part in parts)


def width_text(selection: Selection) -> str:
    """Return the end of a heading that names the width; empty for none or several widths."""
    found = widths([entry.config for entry in selection.entries])
    return f", width {found[0]}" if len(found) == 1 else ""


def notes(selection: Selection) -> list[str]:
    """Return the sentences on omitted configurations, worded for a page."""
    return [
        note.replace("see --where", "choose a width or a condition") for note in selection.notes
    ]


def _light(curve: LossCurve) -> LossCurve:
    """Return a curve without the values of its trials, which the pages do not show."""
    return replace(curve, sample=replace(curve.sample, values=curve.sample.values[:, :0].copy()))


def _curve(curve: LossCurve) -> dict[str, Any]:
    band = curve.band
    values = {"centre": band.centre, "low": band.low, "high": band.high}
    if curve.is_prequential:  # of one step it is noise
        running = pd.Series(band.centre).rolling(WINDOW, min_periods=1, center=True).median()
        nothing = np.full(len(running), np.nan)
        values = {"centre": running.to_numpy(), "low": nothing, "high": nothing}
        values["points"] = band.centre
    return {
        **legend_entry(curve.policy),
        **values,
        "n": band.n,
        "n_diverged": curve.sample.n_diverged,
        "count": curve.sample.describe(),
    }
