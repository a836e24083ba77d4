"""Grid page: a row for each environment and width, a column for each policy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.data.latest_configs import latest
from analysis.data.missing_trials import absent_pairs
from analysis.data.trial_selection import environment_rank, policy_rank
from analysis.serve.policy_labels import legend_entry
from analysis.serve.progress import read_progress
from analysis.serve.query_params import QueryParams
from analysis.serve.state import ServerState
from analysis.stats.intervals import mean, standard_error
from dopt.spec.label import labels
from dopt.spec.prequential import is_prequential
from orchestrate.store import ConfigRow, Reader

_FINAL = """
SELECT config_key, final_loss FROM v_trial
WHERE status = 'done' AND final_loss IS NOT NULL ORDER BY config_key, seed
"""

SHADES = 9
"""Steps of the heat scale."""


def grid(state: ServerState, params: QueryParams) -> dict[str, Any]:  # noqa: ARG001  # the signature is that of every page
    """Return every configuration with its final loss and the status of its trials."""
    reader = state.database.reader()
    progress = read_progress(reader)
    stored = reader.configs()
    configs = latest(reader, stored)
    policies = sorted({config.policy for config in configs}, key=policy_rank)
    finals = state.selections.get_or_compute(
        ("final", reader, progress["token"]), lambda: _finals(reader)
    )
    slots = _slots(configs, finals)
    absent = absent_pairs(configs)
    environments = [
        {"env": env, "rows": _rows(env, slots, policies, absent)}
        for env in sorted({config.env for config in configs}, key=environment_rank)
    ]
    return {
        "progress": progress,
        "policies": [legend_entry(policy) for policy in policies],
        "environments": environments,
        "older": len(stored) - len(configs),
    }


Slots = dict[tuple[str, int | None, str], list[dict[str, Any]]]


def _slots(configs: Sequence[ConfigRow], finals: dict[str, dict[str, Any]]) -> Slots:
    """Return the configurations of each (environment, width, policy), with shades and labels."""
    slots: Slots = {}
    nothing = _final(np.empty(0))
    for env in {config.env for config in configs}:
        own = [config for config in configs if config.env == env]
        widths = {config.width for config in own if config.width is not None}
        only = next(iter(widths)) if len(widths) == 1 else None
        found = [_configuration(config, finals.get(config.config_key, nothing)) for config in own]
        for prequential in (False, True):  # losses of two kinds have two scales
            _shade([one for one in found if is_prequential(one["config"]) is prequential])
        for config, one in zip(own, found, strict=True):
            slots.setdefault((env, config.width or only, config.policy), []).append(one)
    for group in slots.values():
        _label(group)
    return slots


def _configuration(config: ConfigRow, final: dict[str, Any]) -> dict[str, Any]:
    counts = {
        "done": config.n_done,
        "diverged": config.n_diverged,
        "failed": config.n_failed,
        "cancelled": config.n_cancelled,
        "running": config.n_running,
        "pending": config.n_pending,
    }
    return {
        "config_key": config.config_key,
        "width": config.width,
        "n": config.n,
        "ended": config.n - config.n_pending - config.n_running,
        "counts": {status: count for status, count in counts.items() if count},
        "config": config.config,
        **final,
    }


def _finals(reader: Reader) -> dict[str, dict[str, Any]]:
    """Return the mean final loss and its error of every configuration, in one query."""
    losses: dict[str, list[float]] = {}
    for config_key, loss in reader.rows(_FINAL):
        losses.setdefault(config_key, []).append(loss)
    return {config_key: _final(np.array(values)) for config_key, values in losses.items()}


def _final(values: npt.NDArray[np.float64]) -> dict[str, Any]:
    return {
        "loss": float(mean(values)),
        "loss_2se": 2 * float(standard_error(values)),
        "n_used": len(values),
    }


def _shade(found: Sequence[dict[str, Any]]) -> None:
    """Give each configuration of an environment its rank by loss, 0 the lowest, as a shade.

    Ranks, because one loss a thousand times below the others would leave those without contrast.
    """
    ranked = sorted((one for one in found if np.isfinite(one["loss"])), key=lambda one: one["loss"])
    for place, one in enumerate(ranked):
        one["shade"] = round((SHADES - 1) * place / max(len(ranked) - 1, 1))


def _label(group: Sequence[dict[str, Any]]) -> None:
    """Replace the configuration by a label that says how it differs from the others of its cell."""
    configs = [one.pop("config") for one in group]
    plain = len(configs) == 1 and not is_prequential(configs[0])
    found = [""] if plain else labels(configs)
    for one, label in zip(group, found, strict=True):
        one["label"] = label


def _rows(
    env: str, slots: Slots, policies: Sequence[str], absent: Sequence[tuple[str, str]]
) -> list[dict[str, Any]]:
    widths = {width for name, width, _ in slots if name == env}
    return [
        {
            "width": width,
            "cells": [
                {
                    "policy": policy,
                    "missing": (env, policy) in absent,
                    "configurations": slots.get((env, width, policy), []),
                }
                for policy in policies
            ],
        }
        for width in _ordered(widths)
    ]


def _ordered(widths: Iterable[int | None]) -> list[int | None]:
    return sorted(widths, key=lambda width: (width is None, width or 0))
