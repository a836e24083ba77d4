"""Columns of a configuration that tables and lists of trials show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dopt.spec.label import limits_label
from orchestrate.store import ConfigRow

COLUMNS = (
    *("env", "policy", "model", "learner", "width", "depth", "horizon", "dt", "gamma", "task"),
    "limits",
)


def column_text(config: ConfigRow, name: str) -> str:
    """Return the value of a column; "-" where the configuration has none."""
    if name == "limits":
        return limits_label(config.config) or "-"
    value = _task(config) if name == "task" else getattr(config, name)
    return "-" if value is None else str(value)


def differing(configs: Sequence[ConfigRow], always: Sequence[str] = ()) -> list[str]:
    """Return the columns that ``always`` names or that have several values, in their order."""
    return [
        name
        for name in COLUMNS
        if name in always or len({column_text(config, name) for config in configs}) > 1
    ]


def _task(config: ConfigRow) -> object:
    task = config.config.get("task")
    return task.get("name") if isinstance(task, Mapping) else task
