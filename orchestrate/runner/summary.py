"""What a launch says at its beginning and at its end."""

from __future__ import annotations

from collections import Counter

from orchestrate.grid import Grid
from orchestrate.progress import Tally, duration
from orchestrate.settings import LaunchSettings
from orchestrate.store import Registration

SHOWN_CAUSES = 3
"""Causes of failure that are named at the end."""


def opening(grid: Grid, state: Registration, settings: LaunchSettings, url: str) -> str:
    """Say what there is to do, and what will not be done."""
    lines = [f"left out {count:,} trials: {reason}" for reason, count in grid.left_out.items()]
    if grid.repeats:
        lines.append(f"{grid.repeats:,} of {grid.asked:,} jobs name a trial of the grid again")
    counted = f"{state.done + state.diverged:,} of {state.total:,} already done"
    if state.failed:
        counted += f", {state.failed:,} failed before (launch.retry=failed runs them again)"
    if state.running_elsewhere:
        counted += f", {state.running_elsewhere:,} running in another launch"
    todo = f"{len(state.todo):,} to run with executor={settings.executor}"
    lines.append(f"{counted}, {todo if state.todo else 'nothing to run'} · {url}")
    return "\n".join(lines)


def closing(tally: Tally, failures: Counter[str], draining: bool, seconds: float) -> str:
    """Say what has been done, what failed and why, and what is left."""
    lines = [
        f"{tally.total - tally.left - tally.all_failed:,} of {tally.total:,} done, "
        f"{tally.all_failed:,} failed, {tally.diverged:,} diverged now, in {duration(seconds)}"
    ]
    for cause, count in failures.most_common(SHOWN_CAUSES):
        lines.append(f"{count:,} failed: {cause}")
    if tally.left:
        why = "interrupted" if draining else "stopped at the first failure"
        lines.append(f"{why}, {tally.left:,} left: the same command goes on from here")
    return "\n".join(lines)
