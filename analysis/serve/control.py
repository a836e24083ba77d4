"""Control page: success rate and relative cost of assessed trials against explored steps."""

from __future__ import annotations

from typing import Any

import pandas as pd

from analysis.data.latest_configs import latest
from analysis.data.trial_selection import Selection, environment_rank
from analysis.errors import AnalysisError
from analysis.formatting import but_lost, number, share, within
from analysis.serve.curves import widths
from analysis.serve.policy_labels import legend_entry
from analysis.serve.progress import read_progress
from analysis.serve.query_params import QueryParams
from analysis.serve.state import ServerState
from analysis.stats.control import (
    ControlCurve,
    TrueModel,
    control_part,
    measure_control,
    tabulate_control,
)
from orchestrate.store import ConfigRow, Reader

TRUE_MODEL = {
    "policy": "",
    "label": "true model",
    "colour": "#000000",
    "dash": [5, 2],
    "line_width": 1,
}
"""Legend entry of the planner with the true model."""

Curves = tuple[ControlCurve, ...]


def control(state: ServerState, params: QueryParams) -> dict[str, Any]:
    """Return success rate and relative cost of every policy, by environment."""
    reader = state.database.reader()
    assessed = _assessed(reader)
    part, curves = _measured(state, reader, params, assessed)
    environments = dict.fromkeys(curve.env for curve in curves)
    return {
        "progress": read_progress(reader),
        "environments": [
            _environment(env, tuple(curve for curve in curves if curve.env == env))
            for env in environments
        ],
        "notes": part.notes,
        "options": {
            "env": sorted({config.env for config in assessed}, key=environment_rank),
            "width": widths(assessed),
        },
    }


def table(state: ServerState, params: QueryParams) -> pd.DataFrame:
    """Return the same numbers with the columns of figure 5's CSV file."""
    reader = state.database.reader()
    _, curves = _measured(state, reader, params, _assessed(reader))
    if not curves:
        raise AnalysisError(
            "The database has no assessed trials that match: launch a grid with task=control."
        )
    return tabulate_control(curves)


def _assessed(reader: Reader) -> list[ConfigRow]:
    """Return the configurations with a task."""
    configs = latest(reader, reader.configs())
    return [config for config in configs if config.config.get("task")]


def _measured(
    state: ServerState, reader: Reader, params: QueryParams, assessed: list[ConfigRow]
) -> tuple[Selection, Curves]:
    """Return the selected configurations and their curves."""
    env = params.choice("env", {config.env for config in assessed})
    if not assessed:
        return Selection(()), ()
    environments = [env] if env else dict.fromkeys(config.env for config in assessed)
    part = control_part(state.select(reader, params.filter(*environments)))
    key = ("control", reader, part.fingerprint())
    return part, state.cache.get_or_compute(key, lambda: measure_control(reader, part))


def _environment(env: str, curves: Curves) -> dict[str, Any]:
    """Return the curves of one environment and the same numbers as rows of text."""
    steps = sorted({int(t) for curve in curves for t in curve.t})
    truth = curves[0].truth
    return {
        "env": env,
        "steps": steps,
        "truth": {"success": truth.success, "n": truth.n, "lost": truth.lost},
        "curves": [_curve(curve) for curve in curves],
        "rows": [_true_model_row(truth, steps), *(_row(curve, steps) for curve in curves)],
    }


def _curve(curve: ControlCurve) -> dict[str, Any]:
    names = ("success", "success_low", "success_high", "cost", "cost_low", "cost_high")
    values = {name: getattr(curve, name) for name in ("t", "n", "lost", *names)}
    return legend_entry(curve.policy) | values


def _row(curve: ControlCurve, steps: list[int]) -> dict[str, Any]:
    """Return the texts of one policy; a dash after steps at which it was not assessed."""
    at = {int(t): k for k, t in enumerate(curve.t)}
    return {
        "legend_entry": legend_entry(curve.policy),
        "success": [_success(curve, at[t]) if t in at else "–" for t in steps],
        "cost": [_cost(curve, at[t]) if t in at else "–" for t in steps],
        "count": curve.described,
    }


def _success(curve: ControlCurve, k: int) -> str:
    return _rate(curve.success[k], curve.success_low[k], curve.success_high[k])


def _cost(curve: ControlCurve, k: int) -> str:
    text = within(curve.cost[k], curve.cost_low[k], curve.cost_high[k])
    return but_lost(text, int(curve.lost[k]))


def _true_model_row(truth: TrueModel, steps: list[int]) -> dict[str, Any]:
    """Return the texts of the true model, which do not depend on the explored steps."""
    rate = _rate(truth.success, truth.success_low, truth.success_high)
    cost = "1" if truth.lost < truth.n else number(float("nan"))
    return {
        "legend_entry": TRUE_MODEL,
        "success": [rate for _ in steps],
        "cost": [but_lost(cost, truth.lost) for _ in steps],
        "count": str(truth.n),
    }


def _rate(centre: float, low: float, high: float) -> str:
    text = share(centre)
    return text if text == "–" else f"{text} [{share(low)}, {share(high)}]"
