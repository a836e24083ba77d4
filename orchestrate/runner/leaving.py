"""Registration of a grid that workers run after the launch has left."""

from __future__ import annotations

from collections.abc import Callable

from orchestrate.config.grid import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import ExitCode
from orchestrate.executors.factory import Job
from orchestrate.runner.retrying_store import RetryingStore
from orchestrate.runner.summary import registered
from orchestrate.store import URL_VARIABLE

WORKER = "python -m orchestrate work"


def leave(
    store: RetryingStore,
    grid: Grid,
    settings: LaunchSettings,
    job: Job | None,
    say: Callable[[str], None],
) -> ExitCode:
    """Register the grid for workers, and submit the job in which they run."""
    free_trials(store, grid, settings)
    state = store.register(grid.trials)
    if job is None:
        say(f"{registered(grid, state)}; start workers with {WORKER} --db {store.safe_url}")
        return ExitCode.DONE
    say(f"{registered(grid, state)} · {store.safe_url}")
    if state.todo:
        say(job.submit(len(state.todo), {URL_VARIABLE: settings.store_url}))
    return ExitCode.DONE


def free_trials(store: RetryingStore, grid: Grid, settings: LaunchSettings) -> None:
    """Put the trials of dead launches, and those to be run again, back to pending."""
    store.recover()
    if settings.retry:
        store.retry(settings.retry, [trial.trial_key for trial in grid.trials])
