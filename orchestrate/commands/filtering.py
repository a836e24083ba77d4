"""Which configurations a command is about: ``--env`` and ``--policy``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from dopt.errors import unknown_name
from orchestrate.commands.parser import UsageError
from orchestrate.store import Cell, Reader


def add_filters(parser: argparse.ArgumentParser) -> None:
    """Add the options that narrow a command to a part of the grid."""
    parser.add_argument("--env", nargs="+", default=(), help="only these environments")
    parser.add_argument("--policy", nargs="+", default=(), help="only these policies")


def chosen(reader: Reader, arguments: argparse.Namespace) -> list[Cell]:
    """Return the configurations that the options leave; all without options.

    Raises ``UsageError`` for a name that no configuration has.
    """
    cells = reader.cells()
    for column in ("env", "policy"):
        cells = _narrowed(cells, column, getattr(arguments, column))
    return cells


def _narrowed(cells: list[Cell], column: str, names: Sequence[str]) -> list[Cell]:
    known = {getattr(cell, column) for cell in cells}
    for name in names:
        if known and name not in known:
            raise UsageError(str(unknown_name(column, name, known)))
    return [cell for cell in cells if not names or getattr(cell, column) in names]
