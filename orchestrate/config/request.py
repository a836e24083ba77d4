"""Request of a launch: its command line composed by Hydra, in plain types."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from orchestrate.cli_parser import UsageError, as_started
from orchestrate.config.argv import OTHER_SWEEPER
from orchestrate.config.deferred_overrides import apply_deferred, hold_back
from orchestrate.config.grid import TRIAL_SECTIONS, Combination
from orchestrate.config.multirun_check import require_multirun
from orchestrate.config.sweep_axes import parsed_overrides
from orchestrate.config.unknown_keys import reject_unknown

CONFIGURATION = Path(__file__).resolve().parents[1] / "conf"
LAUNCH_SECTIONS = ("launch", "store", "executor")

Expand = Callable[[Sequence[str]], list[Combination]]
"""Function that returns the combinations of the grid for the overrides."""


@dataclass(frozen=True)
class Request:
    """Combinations and launch settings of a command line, in plain types."""

    combinations: Sequence[Combination]
    launch: dict[str, Any]
    overrides: tuple[str, ...]
    single: bool


def read_command_line() -> Request | None:
    """Return the request, or None if Hydra has printed its answer (``--help``, ``--cfg``).

    Raises
    ------
    Exception
        Errors of Hydra and of the grid.
    """
    requests: list[Callable[[tuple[str, ...]], Request]] = []

    @hydra.main(config_path=str(CONFIGURATION), config_name="config", version_base="1.3")
    def capture(task: DictConfig | tuple[DictConfig, Expand]) -> None:
        # Evaluated later: Hydra adds a line of its own to errors raised here.
        if isinstance(task, tuple):
            requests.append(partial(_grid_request, *task))
        else:
            requests.append(partial(_single_request, task, cast(DictConfig, HydraConfig.get())))

    answer = io.StringIO()
    with _errors_let_through():
        try:
            with hold_back() as overrides, redirect_stdout(answer):
                capture()
        finally:
            if text := answer.getvalue():
                sys.stdout.write(as_started(text))
        return requests[0](overrides) if requests else None


@contextmanager
def _errors_let_through() -> Iterator[None]:
    """Make Hydra raise its errors instead of printing them; workers do not inherit the setting."""
    before = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = before


def _grid_request(config: DictConfig, expand: Expand, overrides: tuple[str, ...]) -> Request:
    combinations = expand(overrides)
    apply_deferred(config, overrides)
    return Request(combinations, _plain(config, LAUNCH_SECTIONS), overrides, single=False)


def _single_request(
    config: DictConfig, hydra_config: DictConfig, overrides: tuple[str, ...]
) -> Request:
    if hydra_config.mode == RunMode.MULTIRUN:
        raise UsageError(OTHER_SWEEPER)
    require_multirun(overrides, hydra_config, CONFIGURATION)
    parsed_overrides(overrides)
    reject_unknown(config)
    combination = Combination(_plain(config, TRIAL_SECTIONS))
    return Request([combination], _plain(config, LAUNCH_SECTIONS), overrides, single=True)


def _plain(config: DictConfig, sections: Sequence[str]) -> dict[str, Any]:
    """Return the sections, resolved and in plain types."""
    parts = {key: config[key] for key in sections}
    return {
        key: OmegaConf.to_container(part, resolve=True) if OmegaConf.is_config(part) else part
        for key, part in parts.items()
    }
