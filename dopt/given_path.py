"""Paths that users give: to a program, in its environment or settings, or in a call."""

from __future__ import annotations

import functools
import logging
import os
import re
from pathlib import Path

from dopt.errors import DoptError, SpecificationError

_VARIABLE = re.compile(r"\$(?:\w+|\{[^}]*\}|\([^)]*\))")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_log = logging.getLogger("dopt.given_path")


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
