"""Explorations of a motor, and what a database holds of one."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from dopt import Explorer
from orchestrate.store import Reader
from tests.dopt.explorer.plants import MOTOR, following

STEPS = 300


def explorer(**more: Any) -> Explorer:
    return Explorer(MOTOR, **{"policy": "random", "steps": STEPS, **more})


def drive(one: Explorer, steps: int) -> None:
    x = one.states[-1] if one.n_steps else np.array([0.1, 0.0])
    for _ in range(steps):
        x = following(x, one.ask(x))
        one.tell(x)


def content(url: str) -> dict[str, Any]:
    """Return what a database holds of its only trial, but for times."""
    with Reader.open(url) as reader, reader.moment() as moment:
        [trial] = moment.rows("SELECT * FROM v_trial")
        stored = moment.trajectory(trial.config_key, trial.seed)
        steps = moment.rows("SELECT t, loss, reachable_loss FROM step ORDER BY t")
        assessed = moment.rows("SELECT t, measure, value FROM assessment ORDER BY t")
    names = ("trial_key", "label", "env", "status", "n_steps", "final_loss", "best_loss")
    return {
        **{name: getattr(trial, name) for name in names},
        "steps": [tuple(row) for row in steps],
        "arrays": [stored.states.tolist(), stored.inputs.tolist(), stored.parameters.tolist()],
        "assessed": [tuple(row) for row in assessed],
    }


def without_checksums(journal: Path) -> str:
    """Return the lines of a journal as programs wrote them before there were checksums."""
    text = re.sub(r', "sum": "\w+"}\n', "}\n", journal.read_text())
    return text.replace('"format": 2', '"format": 1', 1)
