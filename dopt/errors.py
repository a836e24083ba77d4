"""Errors of the package, and checks of paths that users give.

Each message says what was given, what was expected, and what to do.
"""

from __future__ import annotations

import functools
import logging
import os
import re
from collections.abc import Iterable
from difflib import SequenceMatcher
from pathlib import Path

DISTRIBUTION = "dopt-exploration"
"""Name of this package for pip, which knows another project by the name of the import."""

SIMILAR = 0.5
"""Names at least so similar, from 0 to 1, are suggested."""


class DoptError(Exception):
    """Base of the package's own errors."""


class SpecificationError(DoptError, ValueError):
    """A trial was described with an unknown name, a wrong type or a value outside its bounds."""


class IncompatibleError(SpecificationError):
    """Two valid choices that make no sense together, such as a periodic input without a mode."""


class ExplorationError(DoptError, RuntimeError):
    """An exploration of a plant cannot go on, or was asked for out of order."""


class UnusableEnvironmentError(DoptError, RuntimeError):
    """Variables, folders or limits of the process let no trial run: that is no trial's failure."""


class ScaleWarning(UserWarning):
    """The quantities that a network is to learn are of another size than its outputs."""


def install_command(extra: str) -> str:
    """Return the command that adds the libraries of an extra to this installation."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def unknown_name(kind: str, given: object, valid: Iterable[str]) -> SpecificationError:
    """Return the error for an unknown name, with the nearest valid one if any is near."""
    names = sorted(valid)
    if not names:
        return SpecificationError(f"{kind} '{given}' is unknown, no {kind} exists: remove it.")
    return SpecificationError(f"{kind} '{given}' is unknown: {suggestion(str(given), names)}")


def counted(number: int, noun: str) -> str:
    """Return a number of things, such as ``1 trial`` or ``2,000 trials``."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def suggestion(given: str, valid: Iterable[str]) -> str:
    """Return what to write in place of a name: the nearest one, if one is similar, then all."""
    names = list(valid)
    near = max(names, key=lambda name: (*_similarity(given, name), name))
    if max(_similarity(given, near)) < SIMILAR:
        return f"choose one of {', '.join(names)}."
    return f"did you mean '{near}'? Choose one of {', '.join(names)}."


def _similarity(given: str, name: str) -> tuple[float, float]:
    """Return how similar two names are at best, and as a whole, from 0 to 1.

    Of names in folders or sections, such as ``beyond/exact`` or ``env.gamma``, the last parts are
    compared too: the folder may be missing, or another one.
    """
    name, given = name.lstrip("-"), given.lstrip("-")
    whole = SequenceMatcher(None, name, given).ratio()
    last = SequenceMatcher(None, re.split("[/.]", name)[-1], re.split("[/.]", given)[-1]).ratio()
    return max(whole, last), whole


_VARIABLE = re.compile(r"\$(?:\w+|\{[^}]*\}|\([^)]*\))")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_log = logging.getLogger("dopt.errors")


def given_path(
    given: str | os.PathLike[str], what: str, refusal: type[DoptError] = SpecificationError
) -> Path:
    """Return the path that a user has given as ``what``, such as ``--out`` or ``DOPT_CACHE``.

    Blanks and line ends around it are left out with a warning, and ``~`` or ``~user`` at its
    beginning becomes the home folder. A variable of a shell, such as ``$HOME``, is refused, because
    only a shell expands it, unless there is a file or folder of that name.

    Raises
    ------
    refusal
        If the path is empty, holds a control character or a variable, or names no home folder.
    """
    path = os.path.expanduser(stripped(os.fspath(given), what, refusal))  # noqa: PTH111
    if not path or path.startswith("~"):
        raise refusal(
            f"{what} is {path!r}, but a path is expected, where ~ alone or with the name of a user "
            f"is a home folder: give it in full, or ./~ for a name that begins with ~."
        )
    for found in _VARIABLE.finditer(path):
        rest = path[found.end() :]
        if not os.path.lexists(path[: found.end()] + rest.partition("/")[0]):
            raise refusal(
                f"{what} is {path!r}, but {found[0]} is expanded by a shell alone: expand it in "
                f"your shell, or give the path in full. A file or folder that has {found[0]} in "
                f"its name has to be there already."
            )
    return Path(path)


def stripped(given: str, what: str, refusal: type[DoptError] = SpecificationError) -> str:
    """Return a text without the blanks and line ends around it, which a warning names.

    The messages do not repeat the text, which may be a URL with a password.

    Raises
    ------
    refusal
        If a control character is left.
    """
    text = given.strip()
    if text != given:
        _say_once(f"{what}: the blanks or line ends around it are left out")
    if found := _CONTROL.search(text):
        raise refusal(
            f"{what} holds the control character {found[0]!r}, but a text of one line is expected: "
            f"remove it, or rename the file."
        )
    return text


@functools.cache
def _say_once(note: str) -> None:
    _log.warning(note)
