"""Columns of the trials page: the fixed ones, and those that tell configurations apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

from dopt.spec.label import labels
from orchestrate.store import ConfigRow

COLUMNS = {
    "env": "environment",
    "policy": "policy",
    "width": "width",
    "model": "model",
    "learner": "learner",
    "gamma": "γ",
    "seed": "seed",
    "status": "status",
    "final_loss": "final loss",
    "best_loss": "best loss",
    "diverged_at": "diverged at",
    "wall_seconds": "wall time",
    "attempt": "attempts",
    "node": "node",
    "error_type": "error",
}
"""Stored columns of the list with their headings; the list can be sorted by each."""

TEXTS = ("env", "policy", "model", "learner", "status", "node", "error_type")
"""Columns that contain text; the others contain numbers."""

NUMBERS = tuple(name for name in COLUMNS if name not in TEXTS)
"""Columns that are aligned to the right."""

OPTIONAL = ("model", "learner", "gamma")
"""Columns that are shown where they differ between configurations of one env and policy."""

COMPUTED = {"task": "task", "settings": "settings"}
"""Columns that are computed from the configuration, with their headings; shown where they differ.

``settings`` is the label of a configuration that no other column tells from another one.
"""

NOT_COMPUTED: Mapping[str, str | None] = {"task": None, "settings": None}
"""Computed columns of a configuration that was registered while the page was made."""

Computed = Mapping[str, Mapping[str, str | None]]
"""Computed columns by configuration key."""


def computed_columns(configs: Sequence[ConfigRow]) -> Computed:
    """Return task and settings of each configuration, by its key."""
    return {
        config.config_key: {"task": _task_name(config), "settings": label}
        for group in _groups(configs)
        for config, label in zip(group, labels([config.config for config in group]), strict=True)
    }


def shown_columns(configs: Sequence[ConfigRow], computed: Computed, sort: str) -> dict[str, str]:
    """Return the headings of the columns to show; the column that sorts the list is always one."""
    groups = list(_groups(configs))
    hidden = {
        name
        for name in OPTIONAL
        if name != sort and all(len({getattr(one, name) for one in group}) < 2 for group in groups)
    }
    shown = {name: text for name, text in COLUMNS.items() if name not in hidden}
    if any(len({computed[one.config_key]["task"] for one in group}) > 1 for group in groups):
        shown["task"] = COMPUTED["task"]
    if any(len({_identity(one, computed) for one in group}) < len(group) for group in groups):
        shown["settings"] = COMPUTED["settings"]
    return shown


def _groups(configs: Sequence[ConfigRow]) -> Iterator[list[ConfigRow]]:
    """Return the configurations of each environment and policy."""
    ordered = sorted(configs, key=_env_and_policy)
    return (list(group) for _, group in groupby(ordered, _env_and_policy))


def _env_and_policy(config: ConfigRow) -> tuple[str, str]:
    return config.env, config.policy


def _identity(config: ConfigRow, computed: Computed) -> tuple[object, ...]:
    """Return the values of a configuration in all columns but its settings."""
    values = (getattr(config, name) for name in ("width", *OPTIONAL))
    return *values, computed[config.config_key]["task"]


def _task_name(config: ConfigRow) -> str | None:
    """Return the name of the task that assesses the trials, None without one."""
    task = config.config.get("task")
    return str(task["name"]) if task else None
