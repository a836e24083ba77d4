"""Trial page: configuration, outcome, provenance, attempts and charts of one trial."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from analysis.data.bounded_states import bounded_states
from analysis.figures.phase_portraits.data import DrawnPlane
from analysis.serve.errors import NotFoundError
from analysis.serve.policy_labels import legend_entry
from analysis.serve.progress import read_progress
from analysis.serve.query_params import QueryParams, truncated
from analysis.serve.state import ServerState
from analysis.stats.spectrum import periodogram
from dopt.errors import SpecificationError
from dopt.spec.added_fields import completed
from dopt.spec.label import flatten
from dopt.spec.prequential import is_prequential, system_of
from dopt.systems import System
from dopt.systems.equilibrium import eigenmode
from orchestrate.store import Reader, Trajectory, explorations
from orchestrate.store.errors import QueryError

_TRIAL = """
SELECT v.*, c.config_json, e.traceback FROM v_trial v
JOIN config c ON c.config_key = v.config_key
JOIN trial r ON r.trial_id = v.trial_id
LEFT JOIN error e ON e.error_id = r.error_id
WHERE v.trial_key = :trial_key
"""
_ATTEMPTS = """
SELECT a.attempt, a.outcome, a.cause, a.launch_id, a.node, a.pid, a.claimed, a.started, a.ended,
       a.wall_seconds, a.cpu_seconds, a.peak_memory_bytes, e.type, e.message, e.traceback
FROM attempt a LEFT JOIN error e ON e.error_id = a.error_id
WHERE a.trial_id = :trial_id ORDER BY a.attempt
"""
_LAUNCHES = """
SELECT launch_id, state, started, ended, host, pid, argv, overrides, git_commit, git_dirty,
       git_diff_hash, versions
FROM launch
WHERE launch_id IN (SELECT launch_id FROM attempt WHERE trial_id = :trial_id) ORDER BY launch_id
"""
_ASSESSED = """
SELECT t, measure, value FROM assessment WHERE trial_id = :trial_id ORDER BY t, measure
"""
_STEPS = "SELECT t, loss, reachable_loss FROM step WHERE trial_id = :trial_id ORDER BY t"
_SAMPLES = """
SELECT t, loss, reachable_loss FROM live_step WHERE trial_id = :trial_id ORDER BY t
"""
_TEXTS = ("argv", "overrides", "versions")


def trial(state: ServerState, params: QueryParams) -> dict[str, Any]:
    """Return everything that is stored of a trial except its arrays, see ``arrays``."""
    reader = state.database.reader()
    row = _row(reader, params)
    config = completed(json.loads(row.pop("config_json")))
    system = _system(config)
    return {
        "progress": read_progress(reader),
        "trial": row,
        "config": flatten(config),
        "attempts": _table(reader, _ATTEMPTS, row["trial_id"]),
        "launches": [
            one | {name: json.loads(one[name]) for name in _TEXTS}
            for one in _table(reader, _LAUNCHES, row["trial_id"])
        ],
        "assessments": _table(reader, _ASSESSED, row["trial_id"]),
        "has_arrays": row["status"] in ("done", "diverged"),
        "waits": row["status"] in ("pending", "running"),
        "exploration": _exploration(reader, row["trial_key"]),
        "system_is_known": system is not None,
        "has_bounded_states": bool(system and bounded_states(config, system)),
        "legend_entry": legend_entry(row["policy"]),
    }


def arrays(state: ServerState, params: QueryParams) -> dict[str, Any]:
    """Return loss, phase-plane path, inputs and their spectrum for the charts."""
    reader = state.database.reader()
    row = _row(reader, params)
    try:
        trajectory = reader.trajectory(row["config_key"], row["seed"])
    except QueryError as error:
        raise NotFoundError(
            f"Trial {row['trial_key'][:12]} is {row['status']} and has no curve: wait for it."
        ) from error
    config = json.loads(row["config_json"])
    system = _system(config)
    labels = system.input_labels if system else _numbered(trajectory)
    return _losses(reader, _STEPS, row) | {
        "diverged_at": row["diverged_at"],
        "dt": row["dt"],
        "gamma": row["gamma"],
        "inputs": [
            {"label": label, "values": values}
            for label, values in zip(labels, trajectory.inputs.T, strict=True)
        ],
        "spectrum": _spectrum(trajectory, row["dt"], system),
        "phase": _phase(trajectory, system) if system else None,
        "bounded": _bounded(trajectory, config, system) if system else [],
    }


def samples(state: ServerState, params: QueryParams) -> dict[str, Any]:
    """Return the samples of the losses of a trial that runs, none of another trial."""
    reader = state.database.reader()
    return _losses(reader, _SAMPLES, _row(reader, params))


def _losses(reader: Reader, sql: str, row: dict[str, Any]) -> dict[str, Any]:
    """Return what the chart of the losses shows."""
    steps = _table(reader, sql, row["trial_id"])
    return {
        **{name: [step[name] for step in steps] for name in ("t", "loss", "reachable_loss")},
        "is_prequential": is_prequential(json.loads(row["config_json"])),
        "legend_entry": legend_entry(row["policy"]),
    }


def _exploration(reader: Reader, trial_key: str) -> dict[str, Any] | None:
    """Return whether an exploration goes on, and its steps; None for another trial."""
    found = (one for one in explorations(reader) if one.trial_key == trial_key)
    return next(({"is_running": one.is_running, "state": one.state} for one in found), None)


def _row(reader: Reader, params: QueryParams) -> dict[str, Any]:
    key = params.text("trial_key")
    found = reader.rows(_TRIAL, trial_key=key)
    if not found:
        raise NotFoundError(
            f"There is no trial '{truncated(key, 20)}' in {reader.safe_url}: "
            f"choose one of the trials page."
        )
    return dict(zip(found.columns, found[0], strict=True))


def _table(reader: Reader, sql: str, trial_id: int) -> list[dict[str, Any]]:
    found = reader.rows(sql, trial_id=trial_id)
    return [dict(zip(found.columns, row, strict=True)) for row in found]


def _system(config: dict[str, Any]) -> System | None:
    """Return the system of a configuration, None for a custom system that is not registered."""
    try:
        return system_of(config)
    except (SpecificationError, KeyError):
        return None


def _numbered(trajectory: Trajectory) -> tuple[str, ...]:
    return tuple(f"u{i + 1}" for i in range(trajectory.inputs.shape[1]))


def _phase(trajectory: Trajectory, system: System) -> dict[str, Any]:
    plane = DrawnPlane.of(system)
    points = plane.project(trajectory.states)
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


def _bounded(
    trajectory: Trajectory, config: dict[str, Any], system: System
) -> list[dict[str, Any]]:
    """Return the states that limits bound, after each step, with their bounds; None for none."""
    return [
        {
            "label": system.state_labels[place],
            "values": trajectory.states[1:, place],
            "bounds": [float(bound) if math.isfinite(bound) else None for bound in bounds],
        }
        for place, bounds in bounded_states(config, system).items()
    ]


def _spectrum(trajectory: Trajectory, dt: float, system: System | None) -> dict[str, Any]:
    """Return the one-sided periodogram without its first and last frequency."""
    inputs = trajectory.inputs
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
