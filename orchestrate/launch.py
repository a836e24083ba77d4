"""Run one trial or a grid of them: ``python orchestrate/launch.py [-m] [key=value ...]``.

Hydra turns the command line into plain settings here; everything after that knows no Hydra.
"""

from __future__ import annotations

import io
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

PACKAGE = Path(__file__).resolve().parent
ROOT = PACKAGE.parent
CONFIGURATION = PACKAGE / "conf"
# Hydra looks for plugins along the module path; a script's own folder comes first there, where its
# modules would hide others of the same name.
sys.path[:] = [path for path in sys.path if path != str(PACKAGE)]
sys.path[:0] = [path for path in (str(ROOT),) if path not in sys.path]
sys.path.append(str(PACKAGE))

from orchestrate.surroundings import pin_threads  # noqa: E402

pin_threads()

import hydra  # noqa: E402
from hydra.core.hydra_config import HydraConfig  # noqa: E402
from hydra.types import RunMode  # noqa: E402
from omegaconf import DictConfig, OmegaConf  # noqa: E402

from dopt.exploration import run_trial  # noqa: E402
from dopt.kernel import warm_up  # noqa: E402
from orchestrate.campaign import Work, launch_grid  # noqa: E402
from orchestrate.capacity import check_memory  # noqa: E402
from orchestrate.errors import ExitCode, InfrastructureError, LaunchError  # noqa: E402
from orchestrate.grid import TRIAL_SECTIONS, Combination, Grid, build_grid  # noqa: E402
from orchestrate.hydra_plugins.dopt_grid._alone import check_alone  # noqa: E402
from orchestrate.hydra_plugins.dopt_grid._first import apply_known, waiting  # noqa: E402
from orchestrate.hydra_plugins.dopt_grid._sentences import sentence_for  # noqa: E402
from orchestrate.hydra_plugins.dopt_grid._unread import check_keys, check_launch  # noqa: E402
from orchestrate.hydra_plugins.dopt_grid._words import OWN_SWEEPER, ordered  # noqa: E402
from orchestrate.passwords import without_password  # noqa: E402
from orchestrate.preview import preview  # noqa: E402
from orchestrate.provenance import launch_record  # noqa: E402
from orchestrate.settings import LaunchSettings  # noqa: E402
from orchestrate.single import launch_trial  # noqa: E402
from orchestrate.store import StoreError, StoreUnavailableError  # noqa: E402
from orchestrate.usage import UsageError  # noqa: E402

WORK = Work(run_trial, warm_up)
LAUNCH_SECTIONS = ("launch", "store", "executor")

Expand = Callable[[Sequence[str]], list[Combination]]
"""Returns the combinations of the grid that overrides of the command line ask for."""


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
    requests: list[Callable[[tuple[str, ...]], Request]] = []

    @hydra.main(config_path=str(CONFIGURATION), config_name="config", version_base="1.3")
    def capture(task: DictConfig | tuple[DictConfig, Expand]) -> None:
        # Read it later: to an error in here Hydra would add a line of its own.
        if isinstance(task, tuple):
            requests.append(partial(_grid_request, *task))
        else:
            requests.append(partial(_single_request, task, cast(DictConfig, HydraConfig.get())))

    with waiting() as words:
        capture()
    return requests[0](words) if requests else None


@contextmanager
def _errors_let_through() -> Iterator[None]:
    """Make Hydra raise its errors instead of printing them; workers do not inherit that."""
    before = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = before


def _grid_request(config: DictConfig, expand: Expand, words: tuple[str, ...]) -> Request:
    combinations = expand(words)
    apply_known(config, words)
    return Request(combinations, _plain(config, LAUNCH_SECTIONS), words, single=False)


def _single_request(
    config: DictConfig, hydra_config: DictConfig, words: tuple[str, ...]
) -> Request:
    if hydra_config.mode == RunMode.MULTIRUN:
        raise UsageError(OWN_SWEEPER)
    check_alone(words, hydra_config, CONFIGURATION)
    check_keys(config)
    combination = Combination(_plain(config, TRIAL_SECTIONS))
    return Request([combination], _plain(config, LAUNCH_SECTIONS), words, single=True)


def _plain(config: DictConfig, sections: Sequence[str]) -> dict[str, Any]:
    """Return the sections, resolved and in plain types."""
    parts = {key: config[key] for key in sections}
    return {
        key: OmegaConf.to_container(part, resolve=True) if OmegaConf.is_config(part) else part
        for key, part in parts.items()
    }


def main() -> int:
    """Run the command line and return the exit code."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        # The words of an exception may hold what a terminal does not know.
        sys.stdout.reconfigure(errors="backslashreplace")
    debug = os.environ.get("HYDRA_FULL_ERROR") == "1"
    try:
        sys.argv[1:] = ordered(sys.argv[1:], CONFIGURATION)
        with _errors_let_through():
            request = read_command_line()
        if request is None:
            return ExitCode.DONE
        grid = build_grid(request.combinations, alone=request.single)
        settings = LaunchSettings.from_mapping(request.launch)
        check_launch(request.launch, CONFIGURATION)
        if settings.path != "kernel":
            grid = grid.on_path(settings.path)
        check_memory(grid, settings)
    except Exception as error:
        if debug:
            raise
        return _refuse(sentence_for(error), ExitCode.BAD_REQUEST)
    return run(request, grid, settings)


def run(request: Request, grid: Grid, settings: LaunchSettings) -> int:
    """Run a grid that has been read, and return the exit code."""
    try:
        for note in grid.notes:
            say(note)
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
    except Exception:
        sys.stderr.write(without_password(traceback.format_exc()))
        sentence = "the program itself has failed, as shown above: what was committed is kept"
        return _refuse(f"{sentence}; report it, and run the same command again.", ExitCode.DEFECT)


def say(text: str) -> None:
    """Write a line for the user at once, also into a pipe."""
    sys.stdout.write(f"{without_password(text)}\n")
    sys.stdout.flush()


def _refuse(sentence: str, code: ExitCode) -> ExitCode:
    sys.stderr.write(f"error: {without_password(sentence)}\n")
    return code


def program() -> None:
    """Run the command line as a program of its own: ``dopt-launch``."""
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(ExitCode.INTERRUPTED)


if __name__ == "__main__":
    program()
