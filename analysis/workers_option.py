"""Option ``--workers`` of the commands that do several things at a time."""

from __future__ import annotations

import argparse

from dopt.cores import usable_cores
from orchestrate.cli_parser import UsageError


def add_workers(command: argparse.ArgumentParser, what: str) -> None:
    """Add the option; ``what`` names the things."""
    cores = usable_cores()
    command.add_argument(
        "--workers", type=_workers, default=cores, help=f"{what} at a time (one for each core)"
    )


def _workers(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise UsageError(f"--workers is {text}, but at least 1 is expected: give a whole number.")
    return int(text)
