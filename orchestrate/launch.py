"""Run one trial or a grid of them: ``python orchestrate/launch.py [-m] [key=value ...]``.

Hydra turns the command line into plain settings here; everything after that knows no Hydra.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [path for path in (str(ROOT),) if path not in sys.path]

from orchestrate.surroundings import pin_threads  # noqa: E402

pin_threads()

import hydra  # noqa: E402
from hydra.core.hydra_config import HydraConfig  # noqa: E402
from omegaconf import DictConfig, OmegaConf  # noqa: E402

from dopt.exploration import run_trial  # noqa: E402
from dopt.kernel import warm_up  # noqa: E402
from orchestrate.campaign import Work, launch_grid  # noqa: E402
from orchestrate.errors import ExitCode, InfrastructureError, LaunchError  # noqa: E402
from orchestrate.grid import TRIAL_SECTIONS, Combination, Grid, build_grid  # noqa: E402
from orchestrate.hydra_plugins.dopt_grid._sentences import sentence_for  # noqa: E402
from orchestrate.preview import preview  # noqa: E402
from orchestrate.provenance import launch_record, without_password  # noqa: E402
from orchestrate.settings import LaunchSettings  # noqa: E402
from orchestrate.single import launch_trial  # noqa: E402
from orchestrate.store import StoreError, StoreUnavailableError  # noqa: E402

WORK = Work(run_trial, warm_up)
LAUNCH_SECTIONS = ("launch", "store", "executor")


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
    requests: list[Callable[[], Request]] = []

    @hydra.main(config_path=str(ROOT / "conf"), config_name="config", version_base="1.3")
    def capture(task: DictConfig | tuple[DictConfig, list[Combination]]) -> None:
        # Read it later: to an error in here Hydra would add a line of its own.
        if isinstance(task, tuple):
            requests.append(partial(_grid_request, *task))
        else:
            requests.append(
                partial(_single_request, task, _words(HydraConfig.get().overrides.task))
            )

    capture()
    return requests[0]() if requests else None


def _grid_request(config: DictConfig, combinations: list[Combination]) -> Request:
    launch = _plain(config, LAUNCH_SECTIONS)
    return Request(combinations, launch, _words(config.hydra.overrides.task), single=False)


def _single_request(config: DictConfig, words: tuple[str, ...]) -> Request:
    combination = Combination(_plain(config, TRIAL_SECTIONS))
    return Request([combination], _plain(config, LAUNCH_SECTIONS), words, single=True)


def _words(overrides: object) -> tuple[str, ...]:
    """Return the overrides as they were typed, references in them included."""
    words = OmegaConf.to_container(overrides, resolve=False)
    return tuple(map(str, words)) if isinstance(words, list) else ()


def _plain(config: DictConfig, sections: Sequence[str]) -> dict[str, Any]:
    """Return the sections, resolved and in plain types."""
    parts = {key: config[key] for key in sections}
    return {
        key: OmegaConf.to_container(part, resolve=True) if OmegaConf.is_config(part) else part
        for key, part in parts.items()
    }


def main() -> int:
    """Run the command line and return the exit code."""
    debug = os.environ.get("HYDRA_FULL_ERROR") == "1"
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then lets its errors through to us
    try:
        # Hydra wants the overrides in one run of words, so -m goes before all of them.
        sys.argv[1:] = sorted(sys.argv[1:], key=lambda word: word not in ("-m", "--multirun"))
        request = read_command_line()
        if request is None:
            return ExitCode.DONE
        grid = build_grid(request.combinations, alone=request.single)
        settings = LaunchSettings.from_mapping(request.launch)
        if settings.path != "kernel":
            grid = grid.on_path(settings.path)
    except Exception as error:
        if debug:
            raise
        return _refuse(sentence_for(error), ExitCode.BAD_REQUEST)
    return run(request, grid, settings)


def run(request: Request, grid: Grid, settings: LaunchSettings) -> int:
    """Run a grid that has been read, and return the exit code."""
    try:
        if settings.dry_run:
            say(preview(grid, settings.store_url))
            return ExitCode.DONE
        record = launch_record(sys.argv, request.overrides, ROOT)
        if not request.single:
            return launch_grid(grid, settings, record, WORK, say=say)
        code, line = launch_trial(grid.trials[0], settings, record, WORK)
        say(line)
        return code
    except (StoreUnavailableError, InfrastructureError) as error:
        return _refuse(str(error), ExitCode.INFRASTRUCTURE)
    except (StoreError, LaunchError) as error:
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
