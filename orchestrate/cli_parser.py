"""Command-line parser whose error messages are one sentence with the nearest valid name."""

from __future__ import annotations

import argparse
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TextIO

from dopt.errors import DoptError, given_path, unknown_name

_INSTALLED = {
    "dopt": "python -m orchestrate",
    "dopt-analysis": "python -m analysis",
    "dopt-launch": "python orchestrate/launch.py",
}


SUCCESSORS = {
    "analysis --figures": "open README.md in the folder of figures",
    "analysis floor": "fit the model of a trial to samples with dopt.fit_offline in Python",
    "--live": "look at the progress of a launch with python -m orchestrate status --watch",
    "launch.live": "look at the progress of a launch with python -m orchestrate status --watch",
    "launch.reference": "compare with python -m analysis compare --reference POLICY",
    "launch.until=decided": "run a fixed range of seeds and python -m analysis compare, or give "
    "launch.until='ci<5%'",
    "export mlflow": "export a bundle, and run studies/trackers/mlflow_runs.py",
    "export wandb": "export a bundle, and run studies/trackers/wandb_runs.py",
    "analysis yardsticks": "python -m studies.yardsticks makes these tables",
    "policy=beyond/sac": "studies/agents/README.md shows it as a policy of a study",
    "policy=beyond/max_agent": "studies/agents/README.md shows it as a policy of a study",
    "experiment=flex_table1_agents": "studies/agents/README.md has it as experiment=agents",
}
"""Successors of removed words, by command and word or by ``key=value`` of the configuration."""


class UsageError(DoptError):
    """Invalid command-line arguments.

    Not a ``ValueError``, so that argument types can raise it through :mod:`argparse`.
    """


class Parser(argparse.ArgumentParser):
    """Parser that raises ``UsageError`` instead of exiting, and rejects abbreviated options."""

    def __init__(self, prog: str, description: str | None = None, **options: Any) -> None:
        super().__init__(
            prog=as_started(prog), description=description, allow_abbrev=False, **options
        )

    def read(self, words: Sequence[str], *, mixed: bool = False) -> argparse.Namespace:
        """Return the arguments; raise ``UsageError`` for a surplus one.

        ``mixed`` accepts options between the positional arguments too.
        """
        read = self.parse_known_intermixed_args if mixed else self.parse_known_args
        arguments, unknown = read(list(words))
        for word in unknown:
            check_removed(f"{self.prog} {word.split('=')[0]}")
            if word.startswith("-"):
                options = {one for one in _options(self, words) if one.startswith("--")}
                raise UsageError(f"{unknown_name('option', word.split('=')[0], options)}")
        if unknown:
            self.error(f"unexpected argument {unknown[0]!r}")
        return arguments

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message.removeprefix('argument ')}: see {self.prog} --help.")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value outside the choices, with the nearest one."""
        if action.choices is not None and value not in action.choices:
            check_removed(f"{self.prog} {value}")
            name = max(action.option_strings, key=len, default=action.metavar or action.dest)
            names = [str(choice) for choice in action.choices]
            raise UsageError(f"{unknown_name(str(name).lower(), value, names)}")


_UNSEEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Control characters but for the tab and the newline, and what changes the direction of text."""


def visible(text: str) -> str:
    """Return a text for a terminal: what would command it, such as an escape, as its code."""
    return _UNSEEN.sub(lambda found: ascii(found[0])[1:-1], text)


def tell(stream: TextIO, text: str, *, exact: bool = False) -> None:
    """Write a text that may come from a database; an ``exact`` one as it is for programs."""
    stream.write(text if exact and not stream.isatty() else visible(text))
    stream.flush()


def discard_output() -> None:
    """Leave out the rest of the output, whose reader, such as ``head``, has closed it."""
    with suppress(io.UnsupportedOperation):  # it is no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def as_started(text: str) -> str:
    """Return a text with the names of the installed programs, if one of them is running."""
    if Path(sys.argv[0]).name in _INSTALLED:
        for name, command in _INSTALLED.items():
            text = text.replace(command, name)
    return text


def _options(parser: argparse.ArgumentParser, words: Sequence[str]) -> Iterator[str]:
    """Yield the options of a parser, and of the commands among ``words``."""
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for name in set(words) & set(action.choices):
                yield from _options(action.choices[name], words)


def removed_word(typed: str) -> str | None:
    """Return what takes the place of a removed word; None if the text ends with no removed word.

    ``typed`` may begin with what leads to the word, such as ``python -m analysis floor``.
    """
    words = f" {typed}".replace(" dopt-", " ")
    for word, successor in SUCCESSORS.items():
        if words.endswith(f" {word}"):
            return f"'{word}' was removed: {successor}."
    return None


def check_removed(typed: str) -> None:
    """Raise ``UsageError`` if a typed text ends with a removed word."""
    if sentence := removed_word(typed):
        raise UsageError(sentence)


def positive(option: str, number: type[int] | type[float]) -> Callable[[str], float]:
    """Return the argument type for a number above 0."""

    def read(given: str) -> float:
        try:
            value = number(given)
        except ValueError:
            value = number(0)
        if not 0 < value < float("inf"):
            kind = "whole number" if number is int else "number"
            raise UsageError(f"{option} is {given!r}, a {kind} above 0 is expected: give one.")
        return value

    return read


def path(option: str) -> Callable[[str], Path]:
    """Return the argument type for the path of a file or folder."""
    return partial(given_path, what=option, refusal=UsageError)


def integer(option: str) -> Callable[[str], int]:
    """Return the argument type for a whole number that a database can hold, 0 or above."""

    def read(given: str) -> int:
        try:
            value = int(given)
        except ValueError:
            value = -1
        if not 0 <= value < 2**63:
            raise UsageError(
                f"{option} is {given!r}, a whole number from 0 to 2^63 - 1 is expected: give one."
            )
        return value

    return read


LONGEST = 100 * 365 * 86_400
"""Longest time [s] that an option takes: a hundred years."""

_TIME = re.compile(r"(?:(\d+)d)?(?:(\d+)h)?(?:(\d+)m)?(?:(\d+(?:\.\d+)?)s?)?")


def length_of_time(option: str) -> Callable[[str], float]:
    """Return the argument type for a time in seconds, such as ``90d``, ``1h30m`` or ``90``."""

    def read(given: str) -> float:
        found = _TIME.fullmatch(given)
        parts = [float(part or 0) for part in found.groups()] if found else [0.0] * 4
        whole = sum(part * unit for part, unit in zip(parts, (86_400, 3_600, 60, 1), strict=True))
        if whole > LONGEST:
            raise UsageError(
                f"{option} is {given!r}, at most a hundred years are expected: give a shorter time."
            )
        if not whole:
            raise UsageError(
                f"{option} is {given!r}, a time such as 55m, 1h30m or 90s is expected: give one."
            )
        return whole

    return read
