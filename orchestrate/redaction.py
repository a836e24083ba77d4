"""Passwords are hidden in everything that is stored or printed.

A password may stand in a URL, in its query, or in a variable such as ``PGPASSWORD``. What looks
like one is hidden by its place; what the command line and the environment give is known, and hidden
wherever it turns up, such as in the message of an exception.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator
from urllib.parse import unquote, unquote_plus

HIDDEN = "***"

SHORTEST = 4
"""A shorter word is no secret, and hiding it everywhere would hide half of a sentence."""

_NAMES = r"(?:password|passwd|passfile|secret|token)"
_SECRET_VARIABLE = re.compile(r"PASSW(OR)?D|SECRET|TOKEN$", re.IGNORECASE)

# In one word of a command line nothing but the password stands before the @, spaces included.
_WORD_QUERY = re.compile(rf"({_NAMES}=)([^&]*)", re.IGNORECASE)
_WORD_URL = re.compile(r"(://[^:/@]*:)(.*)@", re.DOTALL)
_TEXT_QUERY = re.compile(rf"({_NAMES}=)([^&\s'\"]+)", re.IGNORECASE)
_TEXT_URL = re.compile(r"(://[^:/@\s]*:)(\S*)@")


def without_password(text: str) -> str:
    """Return a sentence or a traceback with every password in it replaced."""
    for secret in known_secrets([*sys.argv, *_environment()]):
        text = text.replace(secret, HIDDEN)
    return _TEXT_URL.sub(rf"\1{HIDDEN}@", _TEXT_QUERY.sub(rf"\1{HIDDEN}", text))


def without_password_in_word(word: str) -> str:
    """Return one word of a command line with the passwords of any URL in it replaced."""
    return _WORD_URL.sub(rf"\1{HIDDEN}@", _WORD_QUERY.sub(rf"\1{HIDDEN}", word))


def known_secrets(words: Iterable[str]) -> list[str]:
    """Return the passwords that words hold, as written and as meant, the longest first."""
    written = {match[2] for word in words for match in _matches(word)}
    meant = {form(secret) for secret in written for form in (str, unquote, unquote_plus)}
    return sorted((secret for secret in meant if len(secret) >= SHORTEST), key=len, reverse=True)


def _matches(word: str) -> Iterator[re.Match[str]]:
    yield from _WORD_QUERY.finditer(word)
    yield from _WORD_URL.finditer(_WORD_QUERY.sub(r"\1", word))


def _environment() -> Iterator[str]:
    """Yield the variables that are secret by their name, and those that hold an address."""
    for name, value in os.environ.items():
        if _SECRET_VARIABLE.search(name):
            yield f"password={value}"
        elif "://" in value:
            yield value
