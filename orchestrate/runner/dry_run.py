"""What a grid would do, without doing it: ``launch.dry_run=true``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from dopt.control.task import GOAL_FIELDS
from dopt.spec import TrialSpec
from orchestrate.grid import Grid
from orchestrate.store import NoDatabaseError, Reader

SECTIONS = ("env", "policy", "model", "learner", "task")
NO_TASK = {"name": "none"}
ALWAYS = ("env", "policy")
COUNTS = ("trials", "done", "failed", "to run")

Values = dict[str, object]
"""What a cell is made of: the name of each section, and each field by its dotted path."""


def preview(grid: Grid, url: str) -> str:
    """Return a table of the cells of the grid: trials asked for, done, and left to run.

    A database that does not exist yet is not made.
    """
    status = _statuses(url)
    rows: dict[str, Counter[str]] = {}
    cells: dict[str, Values] = {}
    for trial in grid.trials:
        if trial.config_key not in cells:
            cells[trial.config_key] = _values(trial)
        row = rows.setdefault(trial.config_key, Counter())
        row["trials"] += 1
        row[_heading(status.get(trial.trial_key))] += 1
    shown = _columns(list(cells.values()))
    lines = [[*(_heading_of(column) for column in shown), *COUNTS]]
    for key, row in rows.items():
        lines.append([_text(cells[key].get(column)) for column in shown])
        lines[-1] += [f"{row[name]:,}" for name in COUNTS]
    left_out = [f"left out {count:,} trials: {why}" for why, count in grid.left_out.items()]
    total = sum(rows.values(), Counter[str]())
    plural = "" if total["trials"] == 1 else "s"
    end = f"{total['trials']:,} trial{plural}, {total['done']:,} done, {total['to run']:,} to run"
    return "\n".join([*_aligned(lines), *left_out, end])


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
    return [tuple(row) for row in reader.query("SELECT trial_key, status FROM trial")]


def _heading(status: str | None) -> str:
    if status in ("done", "diverged"):
        return "done"
    return "failed" if status in ("failed", "cancelled") else "to run"


def _values(trial: TrialSpec) -> Values:
    content = trial.to_mapping()
    values: Values = {}
    for section in SECTIONS:
        fields = content.get(section, NO_TASK)
        assert isinstance(fields, dict)
        # Every system has a goal of its own, which is no news.
        told = {key: value for key, value in fields.items() if key not in GOAL_FIELDS}
        values |= {f"{section}.{key}": value for key, value in told.items()}
        values[section] = values.pop(f"{section}.name")
    return values


def _columns(cells: Sequence[Values]) -> list[str]:
    """Return the columns that tell the cells apart.

    A field counts where it differs between cells with the same option of its section: that two
    systems have different masses is no news.
    """
    names = [one for one in SECTIONS if one in ALWAYS or len({cell[one] for cell in cells}) > 1]
    seen: dict[tuple[str, object], str] = {}
    fields: dict[str, None] = {}
    for cell in cells:
        for path in cell.keys() - set(SECTIONS):
            text = _text(cell[path])
            if seen.setdefault((path, cell[path.split(".")[0]]), text) != text:
                fields[path] = None
    return [*names, *sorted(fields)]


def _heading_of(column: str) -> str:
    """Return the key that sets the column."""
    return "width" if column == "model.width" else column


def _text(value: object) -> str:
    return "-" if value is None else str(value)


def _aligned(lines: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return [
        "  ".join(f"{cell:<{w}}" for cell, w in zip(line, widths, strict=True)).rstrip()
        for line in lines
    ]
