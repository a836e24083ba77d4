"""Execution of a launch, from its command line to its exit code."""

from __future__ import annotations

import os
import sys

from dopt.kernel import warm_up
from dopt.run import run_trial
from orchestrate.cli_parser import UsageError
from orchestrate.config.command_line import Request, read_command_line
from orchestrate.config.grid import Grid, build_grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.config.messages import check_launch, format_error
from orchestrate.errors import ExitCode, LaunchError
from orchestrate.executors.registry import executor_factory, make_job
from orchestrate.program import ROOT, answered, say
from orchestrate.runner.dry_run import preview
from orchestrate.runner.memory_check import check_memory
from orchestrate.runner.provenance import launch_record
from orchestrate.runner.run_grid import Work, launch_grid
from orchestrate.runner.run_single import launch_trial
from orchestrate.store import URL_VARIABLE

WORK = Work(run_trial, warm_up)


@answered
def main() -> int:
    """Run the command line and return the exit code."""
    if sys.flags.optimize:
        raise UsageError(
            "Python runs without assertions (PYTHONOPTIMIZE, -O), but Hydra reads no override "
            "without them: unset PYTHONOPTIMIZE."
        )
    if not os.environ.get(URL_VARIABLE):
        os.environ.pop(URL_VARIABLE, None)  # oc.env of the configuration takes "" as a URL
    try:
        request = read_command_line()
        if request is None:
            return ExitCode.DONE
        grid, settings = _checked(request)
    except Exception as error:
        if getattr(error, "errno", None) or isinstance(error, MemoryError):
            raise  # the system refuses something
        raise LaunchError(format_error(error)) from error
    return run(request, grid, settings)


def _checked(request: Request) -> tuple[Grid, LaunchSettings]:
    """Return the checked grid and settings of a launch, or raise ``DoptError``."""
    grid = build_grid(request.combinations, single=request.single)
    settings = LaunchSettings.from_mapping(request.launch)
    check_launch(request.launch)
    from dopt.kernel import cache  # refuses a path of the cache that cannot be meant

    path = executor_factory(settings).path
    if path != "kernel":
        grid = grid.on_path(path)
    if settings.share:
        grid = grid.only(settings.share.holds)
    if not settings.detach:  # workers may run on other machines
        if any(trial.config.path == "kernel" for trial in grid.trials):
            cache.check_environment()
        check_memory(grid, settings)
    _check_kind(settings, single=request.single)
    return grid, settings


def _check_kind(settings: LaunchSettings, *, single: bool) -> None:
    """Refuse settings that do not go together, or that only a grid can have."""
    if settings.until and single:
        raise LaunchError(
            "launch.until chooses among the seeds of a grid, but a single trial is asked for: add "
            "-m and a range such as 'seed=range(100)', or leave launch.until out."
        )
    leaving = _leaving(settings)
    if single and (leaving or settings.share):
        key = leaving or "launch.share"
        raise LaunchError(
            f"{key} is for grids, but a single trial is asked for: add -m, or leave {key} out."
        )
    if settings.share and (leaving or settings.until):
        raise LaunchError(
            f"{leaving or 'launch.until'} needs the whole grid in one database, but launch.share "
            "takes a part of it: leave one of the two out."
        )
    if leaving and settings.until:
        raise LaunchError(
            f"launch.until looks at results before it asks for more seeds, but {leaving} leaves "
            "before there are any: leave one of the two out."
        )


def _leaving(settings: LaunchSettings) -> str:
    """Return the setting by which a launch leaves its grid to workers; empty without one."""
    if settings.detach:
        return "launch.detach"
    return f"executor={settings.executor}" if make_job(settings) else ""


@answered
def run(request: Request, grid: Grid, settings: LaunchSettings) -> int:
    """Run a checked grid and return the exit code."""
    for note in grid.notes:
        say(note)
    if settings.dry_run:
        say(preview(grid, settings.store_url, settings.retry))
        if settings.until:
            say("launch.until may need fewer of these seeds: they are run in batches")
        if job := make_job(settings):
            say(job.text(len(grid.trials)))
        return ExitCode.DONE
    record = launch_record(sys.argv, request.overrides, ROOT)
    if not request.single:
        return launch_grid(grid, settings, record, WORK, say=say)
    code, line = launch_trial(grid.trials[0], settings, record, WORK)
    say(line)
    return code
