"""Filters ``--env`` and ``--policy`` that select configurations."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from dopt.errors import unknown_name
from orchestrate.cli_parser import UsageError
from orchestrate.store import ConfigRow, Reader


def add_filters(parser: argparse.ArgumentParser) -> None:
    """Add the options that select a part of the grid."""
    parser.add_argument("--env", nargs="+", default=(), help="only these environments")
    parser.add_argument("--policy", nargs="+", default=(), help="only these policies")


def chosen(reader: Reader, arguments: argparse.Namespace) -> list[ConfigRow]:
    """Return the configurations that the options select; all without options.

    Raises ``UsageError`` for a name that no configuration has.
    """
    configs = reader.configs()
    for column in ("env", "policy"):
        configs = _filtered(configs, column, getattr(arguments, column))
    return configs


def _filtered(configs: list[ConfigRow], column: str, names: Sequence[str]) -> list[ConfigRow]:
    known = {getattr(config, column) for config in configs}
    for name in names:
        if known and name not in known:
            raise UsageError(str(unknown_name(column, name, known)))
    return [config for config in configs if not names or getattr(config, column) in names]
