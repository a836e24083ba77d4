"""Summary of a launch at its beginning and at its end."""

from __future__ import annotations

from collections import Counter

from orchestrate.config.grid import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.runner.progress import Tally, duration
from orchestrate.runner.scheduler import Scheduler
from orchestrate.store import Registration

MAX_LISTED_CAUSES = 3
"""Causes of failure that the summary lists."""


def registered(grid: Grid, state: Registration) -> str:
    """Return the counts of a grid that was registered for workers."""
    lines = [*left_out(grid), f"{state.done + state.diverged:,} of {state.total:,} already done"]
    if state.failed:
        lines[-1] += f", {state.failed:,} failed before (launch.retry=failed runs them again)"
    if state.running_elsewhere:
        lines[-1] += f", {state.running_elsewhere:,} running"
    lines[-1] += f", {len(state.todo):,} registered"
    return "\n".join(lines)


def left_out(grid: Grid) -> list[str]:
    """Return a line for each reason to leave out trials, and one for repeated jobs."""
    lines = [f"left out {count:,} trials: {reason}" for reason, count in grid.left_out.items()]
    if grid.repeats:
        lines.append(f"{grid.repeats:,} of {grid.n_jobs:,} jobs name a trial of the grid again")
    return lines


def opening(
    grid: Grid, state: Registration, settings: LaunchSettings, url: str, heading: str = ""
) -> str:
    """Return the counts of trials to run, done, failed and left out, after the stage's heading."""
    lines = left_out(grid)
    counted = f"{state.done + state.diverged:,} of {state.total:,} already done"
    if state.failed:
        counted += f", {state.failed:,} failed before (launch.retry=failed runs them again)"
    if state.running_elsewhere:
        counted += f", {state.running_elsewhere:,} running in another launch"
    todo = f"{len(state.todo):,} to run with executor={settings.executor}"
    lines.append(f"{heading}{counted}, {todo if state.todo else 'nothing to run'} · {url}")
    return "\n".join(lines)


def closing(tally: Tally, failures: Counter[str], stop_requested: bool, seconds: float) -> str:
    """Return the counts of outcomes, the commonest failures, and the number of trials left."""
    lines = [
        f"{tally.total - tally.left - tally.all_failed:,} of {tally.total:,} done, "
        f"{tally.all_failed:,} failed, {tally.diverged:,} diverged now, in {duration(seconds)}"
    ]
    for cause, count in failures.most_common(MAX_LISTED_CAUSES):
        lines.append(f"{count:,} failed: {cause}")
    if tally.left:
        why = "interrupted" if stop_requested else "stopped at the first failure"
        lines.append(f"{why}, {tally.left:,} left: run the same command again to continue")
    return "\n".join(lines)


def worked(tally: Tally, scheduler: Scheduler, left: int, seconds: float) -> str:
    """Return the counts of outcomes of a worker, and the number of trials left to others."""
    lines = [
        f"{tally.done + tally.diverged:,} trials done, {tally.diverged:,} of them diverged, "
        f"{tally.failed:,} failed, in {duration(seconds)}; {left:,} left"
    ]
    if scheduler.refused:
        lines.append(
            f"{scheduler.refused:,} results refused: the lease had run out, and others had claimed "
            f"their trials; give a longer --lease"
        )
    for cause, count in scheduler.failures.most_common(MAX_LISTED_CAUSES):
        lines.append(f"{count:,} failed: {cause}")
    return "\n".join(lines)
