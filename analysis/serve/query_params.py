"""The values that come with a request, read strictly: a wrong one is a sentence, never a crash."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import TypeVar

from analysis.choice import Filter, read_condition
from analysis.serve.errors import RequestError

E = TypeVar("E", bound=StrEnum)

LARGEST = 2**31 - 1
"""Bound of whole numbers: both databases take it for every column."""


class Asked:
    """The parameters of a request by name; an empty one counts as not given."""

    def __init__(self, values: Mapping[str, str]) -> None:
        self._values = values

    def text(self, name: str, default: str = "") -> str:
        """Return a text; no database takes one with a zero character."""
        value = self._values.get(name, "").strip()
        if "\0" in value:
            raise RequestError(f"'{name}' holds a zero character, a text is expected: leave it.")
        return value or default

    def one_of(self, name: str, choices: Iterable[str], default: str = "") -> str:
        """Return one of several texts."""
        value, known = self.text(name, default), list(choices)
        if value and value not in known:
            near = difflib.get_close_matches(value, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else "choose one of these."
            raise RequestError(
                f"'{name}' is '{short(value)}', expected is one of "
                f"{', '.join(known) or 'nothing: there is none'}: {hint}"
            )
        return value

    def member(self, name: str, kind: type[E], default: E) -> E:
        """Return a member of an enumeration."""
        return kind(self.one_of(name, list(kind), default))

    def whole(self, name: str, low: int = 0, high: int = LARGEST) -> int | None:
        """Return a whole number within bounds, None where it is not given."""
        value = self.text(name)
        if not value:
            return None
        digits = value.removeprefix("-")
        if digits.isascii() and digits.isdigit() and len(digits) < 20 and low <= int(value) <= high:
            return int(value)
        raise RequestError(
            f"'{name}' is '{short(value)}', expected is a whole number of {low} to {high}: "
            f"write one."
        )

    def place(self, name: str, text: bool) -> tuple[float | str | None, int] | None:
        """Return the place in a sorted list after or before which a page starts.

        ``text`` says whether the list is sorted by texts or by numbers.
        """
        value = self.text(name)
        if not value:
            return None
        try:
            found = json.loads(value)
        except (ValueError, RecursionError):
            found = None
        match found:
            case [None | str() | int() | float() as key, int(row)] if _fits(key) and _fits(row):
                if key is None or isinstance(key, str) is text:
                    return key, row
        raise RequestError(f"'{name}' names no place in the list: start from its first page.")

    def conditions(self) -> dict[str, object]:
        """Return the conditions of ``where`` and ``width``, such as model.width=32."""
        found = dict(_condition(word) for word in self.text("where").split())
        width = self.whole("width", low=1)
        return found if width is None else {**found, "model.width": width}

    def wanted(self, *environments: str) -> Filter:
        """Return the filter of the configurations that are asked for."""
        return Filter(environments, (), self.conditions())


def _fits(value: object) -> bool:
    if isinstance(value, bool) or (isinstance(value, str) and "\0" in value):
        return False
    return not isinstance(value, int | float) or (math.isfinite(value) and abs(value) < 2**63)


def _condition(word: str) -> tuple[str, object]:
    found = read_condition(word)
    if found is None:
        raise RequestError(
            f"'where' holds '{short(word)}', conditions PATH=VALUE are expected: "
            f"write for instance policy.form=dual."
        )
    return found


def short(text: str, length: int = 60) -> str:
    """Return the beginning of a text, fit for a sentence."""
    shown = "".join(letter if letter.isprintable() else "?" for letter in text)
    return shown if len(shown) <= length else f"{shown[: length - 1]}…"
