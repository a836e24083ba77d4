"""What a grid would do, without doing it: ``launch.dry_run=true``."""

from __future__ import annotations

from collections import Counter

from dopt.spec import TrialSpec
from orchestrate.grid import Grid
from orchestrate.store import NoDatabaseError, Reader

COLUMNS = ("env", "policy", "model", "learner", "width", "depth", "horizon", "gamma")


def preview(grid: Grid, url: str) -> str:
    """Return a table of the cells of the grid: trials asked for, done, and left to run.

    A database that does not exist yet is not made.
    """
    status = _statuses(url)
    rows: dict[str, Counter[str]] = {}
    first: dict[str, TrialSpec] = {}
    for trial in grid.trials:
        first.setdefault(trial.config_key, trial)
        row = rows.setdefault(trial.config_key, Counter())
        row["trials"] += 1
        row[_heading(status.get(trial.trial_key))] += 1
    shown = [column for column in COLUMNS if _varies(column, first)]
    lines = [[*shown, "trials", "done", "failed", "to run"]]
    for key, row in rows.items():
        values = first[key].columns()
        lines.append([_text(values[column]) for column in shown])
        lines[-1] += [f"{row[name]:,}" for name in ("trials", "done", "failed", "to run")]
    left_out = [f"left out {count:,} trials: {why}" for why, count in grid.left_out.items()]
    total = sum(rows.values(), Counter[str]())
    end = f"{total['trials']:,} trials, {total['done']:,} done, {total['to run']:,} to run"
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


def _varies(column: str, first: dict[str, TrialSpec]) -> bool:
    return column in ("env", "policy") or len({t.columns()[column] for t in first.values()}) > 1


def _text(value: object) -> str:
    return "-" if value is None else str(value)


def _aligned(lines: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return [
        "  ".join(f"{cell:<{w}}" for cell, w in zip(line, widths, strict=True)).rstrip()
        for line in lines
    ]
