"""Stored explorations: how many steps they have, and which of them go on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from orchestrate.store.read.reader import Reader
from orchestrate.store.schema import PREQUENTIAL

_ROWS = f"""
SELECT v.trial_key, v.config_key, v.env, v.label, v.seed, v.status, v.n_steps, v.horizon,
       v.launch_id
FROM v_trial v
JOIN config c ON c.config_key = v.config_key
WHERE c.config_json LIKE '{PREQUENTIAL}' AND v.status IN ('done', 'diverged')
ORDER BY v.trial_id
"""


@dataclass(frozen=True)
class ExplorationRow:
    """Exploration that was saved.

    Attributes
    ----------
    n_steps, horizon
        Steps that are stored, and the most that there can be.
    is_running
        Whether the process that saves it is alive and can add steps.
    """

    trial_key: str
    config_key: str
    env: str
    label: str
    seed: int
    status: str
    n_steps: int
    horizon: int
    is_running: bool

    @property
    def state(self) -> str:
        """Status and steps, such as ``running, 1,234 of 20,000 steps``."""
        word = "running" if self.is_running else self.status
        return f"{word}, {self.n_steps:,} of {self.horizon:,} steps"


def explorations(reader: Reader) -> list[ExplorationRow]:
    """Return all stored explorations, the oldest first."""
    rows = list(reader.rows(_ROWS))
    if not rows:
        return []
    alive = {one.launch_id for one in reader.launches() if one.state == "running" and one.alive}
    return [_row(row._asdict(), alive) for row in rows]


def _row(values: dict[str, Any], alive: set[int]) -> ExplorationRow:
    is_saved = values.pop("launch_id") in alive
    can_grow = values["status"] == "done" and values["n_steps"] < values["horizon"]
    return ExplorationRow(**values, is_running=is_saved and can_grow)
