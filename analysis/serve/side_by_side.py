"""Page of two databases: the configurations that both hold, with the final losses of each."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from analysis.data.latest_configs import latest
from analysis.data.trial_selection import environment_rank, policy_rank
from analysis.serve.errors import NotFoundError
from analysis.serve.policy_labels import legend_entry
from analysis.serve.progress import read_progress
from analysis.serve.query_params import QueryParams
from analysis.serve.state import ServerState
from analysis.stats.intervals import mean, standard_error
from dopt.spec.config import without_versions
from orchestrate.store import ConfigRow, Reader

_FINAL = """
SELECT config_key, seed, final_loss FROM v_trial
WHERE status = 'done' AND final_loss IS NOT NULL ORDER BY config_key, seed
"""

Losses = dict[int, float]
"""Final loss of each seed."""


def side_by_side(states: Sequence[ServerState], params: QueryParams) -> dict[str, Any]:
    """Return the configurations of two databases; a version of the code makes no difference."""
    if len(states) < 2:
        raise NotFoundError(
            "Only one database is served: give several, python -m analysis serve --db URL URL."
        )
    by_name = {state.name: state for state in states}
    names = [*by_name]
    first = params.choice("first", names, names[0])
    second = params.choice("second", names, next(name for name in names if name != first))
    pair = (by_name[first], by_name[second])
    configs = [_configs(state) for state in pair]
    both = [key for key in configs[0] if key in configs[1]]
    rows = [_row(pair, [found[key] for found in configs]) for key in both]
    return {
        "names": names,
        "first": first,
        "second": second,
        "database": f"{pair[0].database.safe_url} and {pair[1].database.safe_url}",
        "rows": rows,
        "alone": [len(found) - len(both) for found in configs],
    }


def _configs(state: ServerState) -> dict[str, ConfigRow]:
    """Return the newest configurations by their settings, in the order of the grid page."""
    reader = state.database.reader()
    rows = latest(reader, reader.configs())
    rows.sort(key=lambda row: (environment_rank(row.env), policy_rank(row.policy), row.label))
    return {json.dumps(without_versions(row.config), sort_keys=True): row for row in rows}


def _row(pair: Sequence[ServerState], configs: Sequence[ConfigRow]) -> dict[str, Any]:
    """Return one configuration as both databases hold it."""
    losses = [
        _losses(state).get(config.config_key, {})
        for state, config in zip(pair, configs, strict=True)
    ]
    common = losses[0].keys() & losses[1].keys()
    return {
        **legend_entry(configs[0].policy),
        "env": configs[0].env,
        "configuration": configs[0].label,
        "sides": [
            {"base": state.base, "config_key": config.config_key, "n": config.n, **_final(found)}
            for state, config, found in zip(pair, configs, losses, strict=True)
        ],
        "common": len(common),
        "equal": sum(losses[0][seed] == losses[1][seed] for seed in common),
    }


def _losses(state: ServerState) -> dict[str, Losses]:
    """Return the final losses of every configuration."""
    reader = state.database.reader()
    key = ("final by seed", reader, read_progress(reader)["token"])
    return state.selections.get_or_compute(key, lambda: _read(reader))


def _read(reader: Reader) -> dict[str, Losses]:
    found: dict[str, Losses] = {}
    for config_key, seed, loss in reader.rows(_FINAL):
        found.setdefault(config_key, {})[seed] = loss
    return found


def _final(losses: Losses) -> dict[str, Any]:
    if not losses:
        return {"loss": None, "loss_2se": None, "n_used": 0}
    values = np.array([*losses.values()])
    return {
        "loss": float(mean(values)),
        "loss_2se": 2 * float(standard_error(values)),
        "n_used": len(values),
    }
