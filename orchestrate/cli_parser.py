"""An argument parser whose refusals are one sentence with the nearest valid name."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

from dopt.errors import DoptError, unknown_name


class UsageError(DoptError):
    """The words of a command cannot be understood.

    It is no ``ValueError``, so that a type of an argument can raise it through :mod:`argparse`.
    """


class Parser(argparse.ArgumentParser):
    """Raises ``UsageError`` instead of printing usage; takes no abbreviated options."""

    def __init__(self, prog: str, description: str | None = None, **options: Any) -> None:
        super().__init__(prog=prog, description=description, allow_abbrev=False, **options)

    def read(self, words: Sequence[str], *, mixed: bool = False) -> argparse.Namespace:
        """Return the arguments; raise ``UsageError`` for a word too many.

        ``mixed`` takes options between the positional words too.
        """
        read = self.parse_known_intermixed_args if mixed else self.parse_known_args
        arguments, unknown = read(list(words))
        for word in unknown:
            if word.startswith("-"):
                options = {one for one in _options(self, words) if one.startswith("--")}
                raise UsageError(f"{unknown_name('option', word.split('=')[0], options)}")
        if unknown:
            self.error(f"there is a word too many, {unknown[0]!r}")
        return arguments

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message.removeprefix('argument ')}: see {self.prog} --help.")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value that is none of the choices with the nearest one."""
        if action.choices is not None and value not in action.choices:
            name = max(action.option_strings, key=len, default=action.metavar or action.dest)
            names = [str(choice) for choice in action.choices]
            raise UsageError(f"{unknown_name(str(name).lower(), value, names)}")


def _options(parser: argparse.ArgumentParser, words: Sequence[str]) -> Iterator[str]:
    """Yield the options of a parser, and of the commands among ``words``."""
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for name in set(words) & set(action.choices):
                yield from _options(action.choices[name], words)
