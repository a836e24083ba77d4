"""Preview of a grid for ``launch.dry_run=true``: trials to run, done and failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from dopt.control.task import GOAL_FIELDS
from dopt.spec.trial import TrialSpec
from orchestrate.config.grid import Grid
from orchestrate.runner.text_table import aligned
from orchestrate.store import FINISHED, RETRIED, NoDatabaseError, Reader

SECTIONS = ("env", "policy", "model", "learner", "task", "limits")
ABSENT = {"name": "none"}
ALWAYS = ("env", "policy")
COUNTS = ("trials", "done", "failed", "to run")

Values = dict[str, object]
"""Values of a configuration: the name of each section, and each field by its dotted path."""


def preview(grid: Grid, url: str, retry: str | None = None) -> str:
    """Return a table of the configurations: trials requested, done, failed and to run.

    Trials that ``retry`` runs again count as to run. A database that does not exist is not created.
    """
    again = RETRIED[retry] if retry else ()
    status = _statuses(url)
    rows: dict[str, Counter[str]] = {}
    configs: dict[str, Values] = {}
    for trial in grid.trials:
        if trial.config_key not in configs:
            configs[trial.config_key] = _values(trial)
        row = rows.setdefault(trial.config_key, Counter())
        row["trials"] += 1
        found = status.get(trial.trial_key)
        row["to run" if found in again else _heading(found)] += 1
    shown = _columns(list(configs.values()))
    lines = [[*(_heading_of(column) for column in shown), *COUNTS]]
    for key, row in rows.items():
        lines.append([_text(configs[key].get(column)) for column in shown])
        lines[-1] += [f"{row[name]:,}" for name in COUNTS]
    left_out = [f"left out {count:,} trials: {why}" for why, count in grid.left_out.items()]
    total = sum(rows.values(), Counter[str]())
    plural = "" if total["trials"] == 1 else "s"
    end = f"{total['trials']:,} trial{plural}, {total['done']:,} done, {total['to run']:,} to run"
    return "\n".join([*aligned(lines), *left_out, end])


def _statuses(url: str) -> dict[str, str]:
    try:
        reader = Reader.open(url)
    except NoDatabaseError:
        return {}
    try:
        return {str(row[0]): str(row[1]) for row in _rows(reader)}
    finally:
        reader.close()


def _rows(reader: Reader) -> list[tuple[object, ...]]:
    return [tuple(row) for row in reader.rows("SELECT trial_key, status FROM trial")]


def _heading(status: str | None) -> str:
    if status in FINISHED:
        return "done"
    return "failed" if status in ("failed", "cancelled") else "to run"


def _values(trial: TrialSpec) -> Values:
    content = trial.to_mapping()
    values: Values = {}
    for section in SECTIONS:
        fields = content.get(section, ABSENT)
        assert isinstance(fields, dict)
        # The goal belongs to the system, so that it distinguishes no configurations.
        shown = {key: value for key, value in fields.items() if key not in GOAL_FIELDS}
        values |= {f"{section}.{key}": value for key, value in shown.items()}
        values[section] = values.pop(f"{section}.name")
    return values


def _columns(configs: Sequence[Values]) -> list[str]:
    """Return the columns that distinguish the configurations.

    A field is shown if it differs between configurations with the same option of its section; the
    masses of two systems always differ.
    """
    names = [
        one for one in SECTIONS if one in ALWAYS or len({config[one] for config in configs}) > 1
    ]
    seen: dict[tuple[str, object], str] = {}
    fields: dict[str, None] = {}
    for config in configs:
        for path in config.keys() - set(SECTIONS):
            text = _text(config[path])
            if seen.setdefault((path, config[path.split(".")[0]]), text) != text:
                fields[path] = None
    return [*names, *sorted(fields)]


def _heading_of(column: str) -> str:
    """Return the key that sets a column."""
    return "width" if column == "model.width" else column


def _text(value: object) -> str:
    return "-" if value is None else str(value)
