"""Check and reordering of command-line arguments before Hydra parses them."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from hydra._internal.utils import get_args_parser

from dopt.errors import SpecificationError
from orchestrate.cli_parser import Parser, UsageError, check_removed

PROGRAM = "python orchestrate/launch.py"

OTHER_SWEEPER = (
    "hydra/sweeper is set, but this program expands its grids itself: leave hydra/sweeper out."
)

_PATHS = ("store.url", "store.folder", "executor.logs")
_UNQUOTED = re.compile(r"[^'\"]*[~\s][^'\"]*")
"""Path with a character that Hydra takes in quotes alone."""

_CHOICE = re.compile(r"\+{0,2}(?P<group>[\w/]+)(?:@[\w.:]*)?=(?P<value>null|\[.*\]|)\s*")


def normalize(arguments: Sequence[str], folder: Path) -> list[str]:
    """Return the arguments with all flags before the overrides, as Hydra requires.

    Parameters
    ----------
    arguments
        Arguments after the name of the program.
    folder
        Folder of the configuration files, whose subfolders are the groups.

    Raises
    ------
    UsageError
        If a flag is unknown, flags contradict each other, a setting was removed, or the
        sweeper is replaced.
    SpecificationError
        If the option of a group is not a name.
    """
    parser = Parser(prog=PROGRAM, parents=[get_args_parser()], add_help=False)
    flags = parser.read(arguments, mixed=True)
    _check_flags(flags)
    for word in flags.overrides:
        check_removed(word)
        check_removed(word.partition("=")[0])
        if word.startswith("hydra/sweeper=") and word != "hydra/sweeper=grid":
            raise UsageError(OTHER_SWEEPER)
        _check_choice(word, folder)
    options = (word for word in arguments if word not in flags.overrides)
    return [*options, *map(_quoted, flags.overrides)]


def _quoted(word: str) -> str:
    """Return ``launch.until=ci<5%`` or a path with the quotes that Hydra requires around them."""
    key, _, value = word.partition("=")
    rule = key.lstrip("+") == "launch.until" and value.startswith("ci")
    if rule or (key.lstrip("+") in _PATHS and _UNQUOTED.fullmatch(value)):
        return f"{key}='{value}'"
    return word


def _check_flags(flags: argparse.Namespace) -> None:
    if flags.multirun and flags.cfg:
        raise UsageError(
            "-m and --cfg cannot be combined, a configuration is that of one trial: look at a grid "
            "with launch.dry_run=true, or leave out -m."
        )
    given = {
        "--run": flags.run,
        "--multirun": flags.multirun,
        "--cfg": flags.cfg,
        "--shell-completion": flags.shell_completion,
        "--info": flags.info,
    }
    several = [name for name, value in given.items() if value]
    if len(several) > 1:
        raise UsageError(f"{' and '.join(several)} cannot be combined: leave one out.")
    if flags.resolve and not (flags.cfg or flags.help):
        raise UsageError("--resolve goes with --cfg or --help: add one of them.")


def _check_choice(word: str, folder: Path) -> None:
    """Refuse null, a list or an empty value as the option of a group, which Hydra cannot handle."""
    match = _CHOICE.fullmatch(word)
    if not match or match["group"] == "experiment" or not (folder / match["group"]).is_dir():
        return
    group, value = match["group"], match["value"]
    paths = (path.relative_to(folder / group) for path in (folder / group).rglob("*.yaml"))
    names = sorted(
        (path.with_suffix("").as_posix() for path in paths), key=lambda name: ("/" in name, name)
    )
    options = ", ".join(names)
    what = f"the list {value}" if value.startswith("[") else value or "empty"
    raise SpecificationError(
        f"{group} is {what}, but one of {options} is expected: give one, or several to a grid as "
        f"in -m {group}=a,b."
    )
