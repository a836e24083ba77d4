"""Run one trial or a grid of them: ``python orchestrate/launch.py [-m] [key=value ...]``.

Hydra turns the command line into plain settings here; everything after that knows no Hydra.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [path for path in (str(ROOT),) if path not in sys.path]

from orchestrate.surroundings import pin_threads  # noqa: E402

pin_threads()

import hydra  # noqa: E402
from omegaconf import DictConfig, OmegaConf  # noqa: E402

from dopt.exploration import run_trial  # noqa: E402
from dopt.kernel import warm_up  # noqa: E402
from orchestrate.campaign import Work, launch_grid  # noqa: E402
from orchestrate.errors import ExitCode, InfrastructureError  # noqa: E402
from orchestrate.grid import TRIAL_SECTIONS, Combination, Grid, build_grid  # noqa: E402
from orchestrate.hydra_plugins.dopt_grid._sentences import sentence_for  # noqa: E402
from orchestrate.preview import preview  # noqa: E402
from orchestrate.provenance import launch_record, without_password  # noqa: E402
from orchestrate.settings import LaunchSettings  # noqa: E402
from orchestrate.single import launch_trial  # noqa: E402
from orchestrate.store import StoreError, StoreUnavailableError  # noqa: E402

WORK = Work(run_trial, warm_up)


@dataclass(frozen=True)
class Request:
    """What the command line asks for, in plain types."""

    combinations: Sequence[Combination]
    launch: dict[str, Any]
    overrides: tuple[str, ...]
    single: bool


def read_command_line() -> Request | None:
    """Return the request, or None if Hydra has printed what was asked for (``--help``, ``--cfg``).

    Raises
    ------
    Exception
        Hydra's own errors, and those of the grid.
    """
    tasks: list[DictConfig | tuple[DictConfig, list[Combination]]] = []

    @hydra.main(config_path=str(ROOT / "conf"), config_name="config", version_base="1.3")
    def capture(task: DictConfig | tuple[DictConfig, list[Combination]]) -> None:
        tasks.append(task)  # Hydra would add a line of its own to an error in here

    capture()
    return _request(tasks[0]) if tasks else None


def _request(task: DictConfig | tuple[DictConfig, list[Combination]]) -> Request:
    if isinstance(task, tuple):
        config, combinations = task
        overrides = tuple(str(word) for word in config.hydra.overrides.task)
        return Request(combinations, _launch_sections(config), overrides, False)
    sections = {key: task[key] for key in TRIAL_SECTIONS}
    plain = {
        key: OmegaConf.to_container(part, resolve=True) if OmegaConf.is_config(part) else part
        for key, part in sections.items()
    }
    return Request([Combination(plain)], _launch_sections(task), (), True)


def _launch_sections(config: DictConfig) -> dict[str, Any]:
    return {
        key: OmegaConf.to_container(config[key], resolve=True)
        for key in ("launch", "store", "executor")
    }


def main() -> int:
    """Run the command line and return the exit code."""
    debug = os.environ.get("HYDRA_FULL_ERROR") == "1"
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then lets its errors through to us
    try:
        request = read_command_line()
        if request is None:
            return ExitCode.DONE
        grid = build_grid(request.combinations, alone=request.single)
        settings = LaunchSettings.from_mapping(request.launch)
    except Exception as error:
        if debug:
            raise
        return _refuse(sentence_for(error), ExitCode.BAD_REQUEST)
    return run(request, grid, settings)


def run(request: Request, grid: Grid, settings: LaunchSettings) -> int:
    """Run a grid that has been read, and return the exit code."""
    if settings.dry_run:
        say(preview(grid, settings.store_url))
        return ExitCode.DONE
    record = launch_record(sys.argv, request.overrides, ROOT)
    try:
        if not request.single:
            return launch_grid(grid, settings, record, WORK, say=say)
        code, line = launch_trial(grid.trials[0], settings, record, WORK)
        say(line)
        return code
    except (StoreUnavailableError, InfrastructureError) as error:
        return _refuse(str(error), ExitCode.INFRASTRUCTURE)
    except StoreError as error:
        return _refuse(str(error), ExitCode.BAD_REQUEST)


def say(text: str) -> None:
    """Write a line for the user at once, also into a pipe."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _refuse(sentence: str, code: ExitCode) -> ExitCode:
    sys.stderr.write(f"error: {without_password(sentence)}\n")
    return code


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(ExitCode.INTERRUPTED)
