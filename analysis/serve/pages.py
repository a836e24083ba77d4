"""Contents of the pages: grid, curves, trials and one trial, with the numbers of the figures."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pandas as pd

from analysis.data.matching import AnalysisError, latest, nearness
from analysis.data.samples import bounded_states
from analysis.data.selection import Selection, absent_pairs, environment_rank, policy_rank, ranges
from analysis.serve.web import QueryParams, RequestError, ServerState, read_progress, truncated
from analysis.stats.curves import (
    Axis,
    DrawnPlane,
    LossCurve,
    PlotOptions,
    axis_parts,
    mean_columns,
    measure_curves,
    periodogram,
    tabulate_curves,
)
from analysis.style import loss_unit, policy_style
from dopt.assessment import SAMPLE_LOSS
from dopt.errors import SpecificationError
from dopt.explorer.signs import STORED
from dopt.spec.config import flatten, labels
from dopt.spec.trial import is_fit, is_prequential, system_of
from dopt.systems import System
from dopt.systems.properties import eigenmode
from dopt.types import Array
from orchestrate.store import ConfigRow, LaunchRow, QueryError, Reader, failure_kinds, trial_report
from orchestrate.store.records import STATES

Content = dict[str, Any]

SHADES = 9
"""Steps of the heat scale."""

MOST_LAUNCHES, MOST_KINDS = 20, 20
"""Launches and kinds of failures in the head of the grid: the newest and the commonest."""

WINDOW = 25
RUNNING = f"running median of {WINDOW} steps"
LOSSES = ("loss", "reachable_loss")

COLUMNS = {
    "env": "environment",
    "policy": "policy and settings",
    "width": "width",
    "seed": "seed",
    "status": "status",
    "final_loss": "final loss",
    "best_loss": "best loss",
    "sample_loss": "sample loss",
    "diverged_at": "diverged at",
    "wall_seconds": "wall time",
    "attempt": "attempts",
    "node": "node",
    "error_type": "error",
}
"""Columns of the list of trials with their headings; the list can be sorted by each."""

NUMBERS = (
    *("width", "seed", "final_loss", "best_loss", "sample_loss"),
    *("diverged_at", "wall_seconds", "attempt"),
)
"""Columns that are aligned to the right."""

PAGE_ROWS = 50

_FINAL = """
SELECT config_key, final_loss FROM v_trial
WHERE status = 'done' AND final_loss IS NOT NULL ORDER BY config_key, seed
"""
_SAMPLED = f"""
SELECT config_key, value FROM v_assessment
WHERE measure = '{SAMPLE_LOSS}' AND status = 'done' AND value IS NOT NULL ORDER BY config_key, seed
"""
_LISTED = f"""
SELECT v_trial.*, (SELECT a.value FROM assessment a WHERE a.trial_id = v_trial.trial_id
    AND a.t = v_trial.n_steps AND a.measure = '{SAMPLE_LOSS}') AS sample_loss FROM v_trial
"""
_OUTCOMES = """
SELECT launch_id, count(*) FILTER (WHERE outcome IN ('done', 'diverged')) AS finished,
       count(*) FILTER (WHERE outcome = 'failed') AS failed
FROM attempt GROUP BY launch_id
"""
_TRIAL = """
SELECT v.*, c.config_json FROM v_trial v
JOIN config c ON c.config_key = v.config_key WHERE v.trial_key = :trial_key
"""
_ASSESSED = """
SELECT t, measure, value FROM assessment WHERE trial_id = :trial_id ORDER BY t, measure
"""
_FITS = """
SELECT v.trial_key, v.config_key, v.model, v.width, v.n_steps, v.dt, l.started,
       u.value AS useful, w.value AS "window"
FROM v_trial v LEFT JOIN launch l ON l.launch_id = v.launch_id
JOIN assessment u ON u.trial_id = v.trial_id AND u.measure = 'useful'
JOIN assessment w ON w.trial_id = v.trial_id AND w.measure = 'window'
WHERE v.policy = 'recorded' ORDER BY v.trial_id DESC
"""
_STEPS = """
SELECT t, loss, reachable_loss, plan_us + learn_us AS us FROM step
WHERE trial_id = :trial_id ORDER BY t
"""


def legend_entry(policy: str) -> Content:
    """Return label, colour, dashes (in units of the line width) and line width of a policy."""
    style = policy_style(policy)
    return {
        "policy": policy,
        "label": style.label,
        "colour": style.colour,
        "dash": [] if isinstance(style.line, str) else list(style.line[1]),
        "line_width": style.width,
    }


def _environments(configs: Iterable[ConfigRow]) -> list[str]:
    return sorted({config.env for config in configs}, key=environment_rank)


def _policies(configs: Iterable[ConfigRow]) -> list[str]:
    return sorted({config.policy for config in configs}, key=policy_rank)


def _widths(configs: Iterable[ConfigRow]) -> list[int]:
    return sorted({config.width for config in configs if config.width is not None})


def grid(state: ServerState, params: QueryParams) -> Content:  # noqa: ARG001  # as every page
    """Return every configuration with its final loss and trials, launches and failures."""
    reader = state.database.reader()
    progress = read_progress(reader)
    stored = [config for config in reader.configs() if not is_fit(config.config)]
    configs = latest(reader, stored)
    fits = reader.rows(_FITS)
    finals = state.selections.get_or_compute(
        ("final", reader, progress["token"]), lambda: _by_config(reader, _FINAL)
    )
    losses = finals, _by_config(reader, _SAMPLED)
    policies, absent = _policies(configs), absent_pairs(configs)
    return {
        "progress": progress,
        "policies": [legend_entry(policy) for policy in policies],
        "environments": [
            {
                "env": env,
                "rows": _rows([c for c in configs if c.env == env], policies, absent, losses),
            }
            for env in _environments(configs)
        ],
        "older": len(stored) - len(configs),
        "fits": [row._asdict() for row in fits],
        **_launches(reader),
    }


def _by_config(reader: Reader, sql: str) -> dict[str, Array]:
    losses: dict[str, list[float]] = {}
    for config_key, loss in reader.rows(sql):
        losses.setdefault(config_key, []).append(loss)
    return {config_key: np.array(values) for config_key, values in losses.items()}


def _rows(
    configs: Sequence[ConfigRow],
    policies: Sequence[str],
    absent: Sequence[tuple[str, str]],
    losses: Sequence[Mapping[str, Array]],
) -> list[Content]:
    """Return a row for each width of an environment, with a cell for each policy.

    The configuration that is nearest to the defaults is the first of its cell.
    """
    widths = _widths(configs)
    only = widths[0] if len(widths) == 1 else None
    tiles = [
        _tile(config, *(one.get(config.config_key, np.empty(0)) for one in losses))
        for config in configs
    ]
    for kind in (False, True):  # prequential losses have another scale
        _shade([t for c, t in zip(configs, tiles, strict=True) if is_prequential(c.config) is kind])
    cells: dict[tuple[int | None, str], list[tuple[ConfigRow, Content]]] = {}
    for config, tile in zip(configs, tiles, strict=True):
        cells.setdefault((config.width or only, config.policy), []).append((config, tile))
    for cell in cells.values():
        own = [config.config for config, _ in cell]
        words = labels(own) if len(own) > 1 or is_prequential(own[0]) else [""]
        for (_, tile), label in zip(cell, words, strict=True):
            tile["label"] = label
        cell.sort(key=lambda one: one[1]["label"])
        cell.sort(key=lambda one: nearness(one[0]), reverse=True)
    return [
        {
            "width": width,
            "cells": [
                {
                    "missing": (configs[0].env, policy) in absent,
                    "configurations": [tile for _, tile in cells.get((width, policy), ())],
                }
                for policy in policies
            ],
        }
        for width in sorted({width for width, _ in cells}, key=lambda w: (w is None, w or 0))
    ]


def _tile(config: ConfigRow, losses: Array, samples: Array) -> Content:
    return {
        "config_key": config.config_key,
        "policy": config.policy,
        "n": config.n,
        "ended": config.n - config.n_pending - config.n_running,
        "counts": {state: count for state, count in config.counts.items() if count},
        **mean_columns("loss", losses),
        **(mean_columns("sample_loss", samples) if len(samples) else {}),
        "n_used": len(losses),
    }


def _shade(tiles: Sequence[Content]) -> None:
    """Give each configuration of an environment its rank by loss, 0 the lowest, as a shade.

    Ranks, because one loss a thousand times below the others would leave those without contrast.
    """
    ranked = sorted((one for one in tiles if np.isfinite(one["loss"])), key=lambda one: one["loss"])
    for place, one in enumerate(ranked):
        one["shade"] = round((SHADES - 1) * place / max(len(ranked) - 1, 1))


def _launches(reader: Reader) -> Content:
    """Return the newest launches with the trials that they ended, and the failures by kind."""
    with reader.moment() as moment:
        configs = {config.config_key: config for config in moment.configs()}
        failures = failure_kinds(moment, configs, MOST_KINDS)
        found = moment.launches()[::-1]
        outcomes = {int(row[0]): row[1:] for row in moment.rows(_OUTCOMES)}
    return {
        "launches": [
            _launch(one)
            | dict(zip(("finished", "failed"), outcomes.get(one.launch_id, (0, 0)), strict=True))
            for one in found[:MOST_LAUNCHES]
        ],
        "n_launches": len(found),
        "failures": [
            {name: getattr(kind, name) for name in ("cause", "type", "message", "trials")}
            | {"places": [f"{env}/{policy}" for env, policy in sorted(kind.places)]}
            | {"traceback": kind.traceback}
            for kind in failures[:MOST_KINDS]
        ],
    }


def _launch(launch: LaunchRow) -> Content:
    lost = launch.state == "running" and not launch.alive
    end = datetime.now(UTC) if launch.ended is None else datetime.fromisoformat(launch.ended)
    length = end - datetime.fromisoformat(launch.started)
    return {
        "launch_id": launch.launch_id,
        "kind": launch.kind,
        "state": "lost" if lost else launch.state,
        "started": launch.started,
        "seconds": None if lost else length.total_seconds(),
        "host": launch.host,
        "command": shlex.join(launch.argv),
    }


def choices(state: ServerState, params: QueryParams) -> Content:
    """Return the stored environments, each with its widths."""
    stored = _by_environment(state.database.reader())
    return {
        "env": params.choice("env", stored, next(iter(stored), "")),
        "environments": {env: _widths(configs) for env, configs in stored.items()},
    }


def _by_environment(reader: Reader) -> dict[str, list[ConfigRow]]:
    """Return the stored configurations by environment, in the paper's order."""
    configs = latest(reader, reader.configs())
    return {env: [one for one in configs if one.env == env] for env in _environments(configs)}


def curves(state: ServerState, params: QueryParams) -> Content:
    """Return the curve and interval of every policy in one environment, and the missing trials.

    ``main`` holds the limits of the upper part of the axis where figure 1 has an axis break, else
    None.
    """
    selection, found = _measured(state, params)
    parts = axis_parts([curve.band for curve in found])
    widths = _widths(entry.config for entry in selection.entries)
    return {
        "env": found[0].env,
        "is_prequential": found[0].is_prequential,
        "unit": found[0].unit,
        "statistic": RUNNING if found[0].is_prequential else found[0].statistic.label,
        "band": found[0].statistic.band,
        "x": max((curve.x for curve in found), key=len),
        "main": parts.upper if parts.lower else None,
        "curves": [_curve(curve) for curve in found],
        "widths": f", width {widths[0]}" if len(widths) == 1 else "",
        "notes": [one.replace("--where", "the fields Width and Where") for one in selection.notes],
        "missing": [
            {"policy": gap.policy, "states": gap.states, "seeds": ranges(gap.seeds)}
            for gap in selection.gaps
        ],
    }


def curves_table(state: ServerState, params: QueryParams) -> str:
    """Return the curves as a CSV with the columns of figure 1's file."""
    return tabulate_curves(_measured(state, params)[1]).to_csv(index=False)


def _measured(state: ServerState, params: QueryParams) -> tuple[Selection, tuple[LossCurve, ...]]:
    reader = state.database.reader()
    env = params.text("env") or next(iter(_by_environment(reader)), "")
    if not env:
        raise AnalysisError(
            "The database has no trials yet: curves appear when the first trial has ended."
        )
    selection = state.select(reader, params.filter(env))
    column = params.choice("column", LOSSES, "loss")
    options = PlotOptions(params.member("x", Axis, Axis.STEPS))

    def cached(part: Selection) -> LossCurve:
        key = ("curve", reader, part.fingerprint(), column, options)
        return state.cache.get_or_compute(
            key, lambda: measure_curves(reader, part, column, options)[0]
        )

    parts = [replace(selection, entries=(entry,), gaps=()) for entry in selection.entries]
    return selection, tuple(cached(part) for part in parts)


def _curve(curve: LossCurve) -> Content:
    band = curve.band
    values = {"values": band.centre, "low": band.low, "high": band.high}
    if curve.is_prequential:  # of one step it is noise
        running = pd.Series(band.centre).rolling(WINDOW, min_periods=1, center=True).median()
        values = {"values": running.to_numpy(), "points": band.centre}
    return legend_entry(curve.policy) | values | {"count": curve.count}


def trials(state: ServerState, params: QueryParams) -> Content:
    """Return one page of the list and the number of matches."""
    reader = state.database.reader()
    configs = reader.configs()
    environments, policies = _environments(configs), _policies(configs)
    given = {
        "env": params.choice("env", environments),
        "policy": params.choice("policy", policies),
        "status": params.choice("status", STATES),
        "config_key": params.text("config"),
        "width": params.integer("width", low=1),
        "seed": params.integer("seed", high=2**63 - 1),
        "launch_id": params.integer("launch"),
    }
    wanted = {column: value for column, value in given.items() if value not in ("", None)}
    where = " AND ".join(["1 = 1", *(f"{column} = :{column}" for column in wanted)])
    sort = params.choice("sort", COLUMNS, "env")
    order = params.choice("order", ("asc", "desc"), "asc")
    page = params.integer("page", low=1) or 1
    total = int(reader.rows(f"SELECT count(*) AS n FROM v_trial WHERE {where}", **wanted)[0].n)
    found = reader.rows(
        f"SELECT trial_key, label, {', '.join(COLUMNS)} FROM ({_LISTED}) AS v WHERE {where} "
        f"ORDER BY CASE WHEN {sort} IS NULL THEN 1 ELSE 0 END, {sort} {order}, trial_id "
        f"LIMIT {PAGE_ROWS} OFFSET {PAGE_ROWS * (page - 1)}",
        **wanted,
    )
    return {
        "progress": read_progress(reader),
        "rows": [row._asdict() for row in found],
        "total": total,
        "sort": sort,
        "order": order,
        "at": page,
        "last": max(1, math.ceil(total / PAGE_ROWS)),
        "columns": COLUMNS,
        "numbers": NUMBERS,
        "legend": {name: legend_entry(name) for name in policies},
        "options": {
            "env": environments,
            "policy": {name: policy_style(name).label for name in policies},
            "width": _widths(configs),
            "status": STATES,
        },
    }


def trial(state: ServerState, params: QueryParams) -> Content:
    """Return everything that is stored of a trial except its arrays, see ``arrays``."""
    reader = state.database.reader()
    found = trial_report(reader, _row(reader, params)["trial_id"])
    row, config, saved = dict(found.trial), dict(found.config), found.exploration
    system = _system(config)
    fit = _fit(reader, row, config)
    return {
        "progress": read_progress(reader),
        "trial": row,
        "config": flatten(config),
        "attempts": found.attempts,
        "launches": found.launches,
        "assessments": [] if fit else _table(reader, _ASSESSED, row["trial_id"]),
        "fit": fit,
        "signs": STORED,
        "has_arrays": row["status"] in ("done", "diverged"),
        "exploration": saved and {"is_running": saved.is_running, "state": saved.state},
        "system_is_known": system is not None,
        "has_bounded_states": bool(system and bounded_states(config, system)),
        "legend_entry": legend_entry(row["policy"]),
    }


def arrays(state: ServerState, params: QueryParams) -> Content:
    """Return losses, phase-plane path, inputs and their spectrum for the charts."""
    reader = state.database.reader()
    row = _row(reader, params)
    try:
        trajectory = reader.trajectory(row["config_key"], row["seed"])
    except QueryError as error:
        raise RequestError(
            f"Trial {row['trial_key'][:12]} is {row['status']} and has no curve: wait for it.", 404
        ) from error
    config = json.loads(row["config_json"])
    system = _system(config)
    steps = _table(reader, _STEPS, row["trial_id"])
    inputs, states = trajectory.inputs, trajectory.states
    names = system.input_labels if system else [f"u{i + 1}" for i in range(inputs.shape[1])]
    bounded = bounded_states(config, system) if system else {}
    return {
        **{name: [step[name] for step in steps] for name in ("t", *LOSSES)},
        "is_prequential": is_prequential(config),
        "unit": loss_unit(system) if system else None,
        "fit": _fit(reader, row, config),
        "legend_entry": legend_entry(row["policy"]),
        "dt": row["dt"],
        "gamma": row["gamma"],
        "inputs": [
            {"label": name, "values": values} for name, values in zip(names, inputs.T, strict=True)
        ],
        "bounded": [
            {"label": system.state_labels[i], "values": states[1:, i], "bounds": bounds}
            for i, bounds in bounded.items()
            if system
        ],
        "spectrum": _spectrum(inputs, row["dt"], system),
        "durations": _durations([step["us"] for step in steps if step["us"]]),
        "phase": _phase(states, system) if system else None,
    }


AHEAD = ("rms", "median", "physics", "linear", "unchanged")
"""Errors of a fit's predictions (:data:`dopt.fitting.export.FIT_MEASURES`)."""


def _fit(reader: Reader, trial: Content, config: Content) -> Content | None:
    """Return the numbers of a fit, None of another trial: constants with errors, and the others.

    Errors of predictions have a row for each measured state and time ahead.
    """
    if not is_fit(config):
        return None
    errors: dict[tuple[str, int], Content] = {}
    named: dict[str, float | None] = {}
    for one in _table(reader, _ASSESSED, trial["trial_id"]):
        kind, _, state = one["measure"].partition(".")
        if kind in AHEAD:
            row = {"state": state, "seconds": one["t"] * trial["dt"]}
            errors.setdefault((state, one["t"]), row)[kind] = one["value"]
        else:
            named[one["measure"]] = one["value"]
    names = [name.partition(".")[2] for name in named if name.startswith("constant.")]
    return {
        "constants": {
            name: (named.pop(f"constant.{name}"), named.pop(f"error.{name}")) for name in names
        },
        "errors": [errors[key] for key in sorted(errors)],
        "numbers": named,
    }


def _row(reader: Reader, params: QueryParams) -> Content:
    key = params.text("trial_key")
    found = reader.rows(_TRIAL, trial_key=key)
    if not found:
        raise RequestError(
            f"There is no trial '{truncated(key, 20)}' in {reader.safe_url}: "
            f"choose one of the trials page.",
            404,
        )
    return dict(found[0]._asdict())


def _table(reader: Reader, sql: str, trial_id: int) -> list[Content]:
    return [row._asdict() for row in reader.rows(sql, trial_id=trial_id)]


def _system(config: Content) -> System | None:
    """Return the system of a configuration, None for a custom system that is not registered."""
    try:
        return system_of(config)
    except (SpecificationError, KeyError):
        return None


def _phase(states: Array, system: System) -> Content:
    plane = DrawnPlane.of(system)
    points = plane.project(states)
    points = points[np.isfinite(points).all(axis=1)]
    line = plane.line(points) if len(points) else points
    return {
        "x": line[:, 0],
        "y": line[:, 1],
        "start": plane.wrapped(points[:1])[0] if len(points) else None,
        "labels": plane.labels,
        "angles": plane.angles,
        "box": plane.box,
    }


PARTS_OF_TEN = 10
"""Bars of the histogram from a time to its tenfold."""


def _durations(us: Sequence[float]) -> Content:
    """Return a histogram of times [µs] of plans and learning, (k,) each, and their quantiles."""
    if not us:
        return {"us": [], "steps": [], "quantiles": []}
    places = np.floor(PARTS_OF_TEN * np.log10(us)).astype(int)
    return {
        "us": 10.0 ** ((np.arange(places.min() - 1, places.max() + 2) + 0.5) / PARTS_OF_TEN),
        "steps": [0, *np.bincount(places - places.min()).tolist(), 0],  # an axis has a length
        "quantiles": np.quantile(us, [0.5, 0.99, 1.0]),
    }


def _spectrum(inputs: Array, dt: float, system: System | None) -> Content:
    """Return the one-sided periodogram without its first and last frequency."""
    inputs = inputs[np.isfinite(inputs).all(axis=1)]
    mode = eigenmode(system) if system else None
    frequency, density = np.empty(0), np.empty((1, 0))
    if len(inputs) > 3:
        frequency, density = periodogram(inputs[None], dt)
    return {
        "frequency": frequency[1:-1],
        "density": density[0, 1:-1],
        "eigenfrequency": mode.frequency / (2 * math.pi) if mode else None,
    }
