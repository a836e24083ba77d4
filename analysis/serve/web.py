"""Requests and answers: query parameters, errors, and content as JSON, CSV or an HTML page."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from datetime import datetime
from decimal import Decimal
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from starlette.responses import HTMLResponse, Response

from analysis.data.matching import Filter, read_condition
from analysis.errors import AnalysisError
from analysis.formatting import number, plus_minus
from analysis.line_styles import environment_title
from dopt.errors import suggestion

E = TypeVar("E", bound=StrEnum)

FOLDER = Path(__file__).parent

LARGEST = 2**31 - 1
"""Largest integer; both databases accept it for every integer column."""

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class RequestError(AnalysisError):
    """A query parameter has an invalid value."""


class NotFoundError(AnalysisError):
    """The trial does not exist."""


class ForbiddenError(AnalysisError):
    """The request comes from another site, or needs a right that is not given."""


class BusyError(AnalysisError):
    """Too many queries are running."""


class QueryParams:
    """Query parameters by name; an empty value counts as not given, an invalid one is an error."""

    def __init__(self, values: Mapping[str, str]) -> None:
        self._values = values

    def text(self, name: str, default: str = "") -> str:
        """Return a text; zero characters are refused because no database accepts them."""
        value = self._values.get(name, "").strip()
        if "\0" in value:
            raise RequestError(
                f"'{name}' holds a zero character, a text is expected: remove that character."
            )
        return value or default

    def choice(self, name: str, choices: Iterable[str], default: str = "") -> str:
        """Return one of several texts."""
        value, known = self.text(name, default), list(choices)
        if value and value not in known:
            hint = suggestion(value, known) if known else "remove it, none exists."
            raise RequestError(f"'{name}' is '{truncated(value)}', which is not valid: {hint}")
        return value

    def member(self, name: str, kind: type[E], default: E) -> E:
        """Return a member of an enumeration."""
        return kind(self.choice(name, list(kind), default))

    def integer(self, name: str, low: int = 0, high: int = LARGEST) -> int | None:
        """Return an integer within bounds, None if it is not given."""
        value = self.text(name)
        if not value:
            return None
        digits = value.removeprefix("-")
        if digits.isascii() and digits.isdigit() and len(digits) < 20 and low <= int(value) <= high:
            return int(value)
        raise RequestError(
            f"'{name}' is '{truncated(value)}', expected is a whole number of {low} to {high}: "
            f"write one."
        )

    def filter(self, environment: str) -> Filter:
        """Return the filter of an environment's configurations with ``where`` and ``width``."""
        conditions = dict(_condition(word) for word in self.text("where").split())
        width = self.integer("width", low=1)
        if width is not None:
            conditions["model.width"] = width
        return Filter((environment,), (), conditions)


def _condition(word: str) -> tuple[str, object]:
    found = read_condition(word)
    if found is None:
        raise RequestError(
            f"'where' holds '{truncated(word)}', conditions PATH=VALUE are expected: "
            f"write for instance policy.form=dual."
        )
    return found


def truncated(text: str, length: int = 60) -> str:
    """Return the start of a text with unprintable characters replaced."""
    shown = "".join(letter if letter.isprintable() else "?" for letter in text)
    return shown if len(shown) <= length else f"{shown[: length - 1]}…"


def plain(value: Any) -> Any:
    """Return a value that JSON can represent: non-finite numbers as None, arrays as lists."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, str | bool | int | None):
        return value
    return str(value)


def as_json(content: Mapping[str, Any], status: int = 200) -> Response:
    """Return a JSON response."""
    text = json.dumps(plain(content), allow_nan=False, separators=(",", ":"))
    return Response(text, status, media_type="application/json")


def as_csv(text: str, name: str) -> Response:
    """Return a CSV response that the browser saves as a file."""
    headers = {"content-disposition": f'attachment; filename="{name}.csv"'}
    return Response(text, media_type="text/csv", headers=headers)


def as_page(template: str, content: Mapping[str, Any], status: int = 200) -> Response:
    """Return an HTML page."""
    return HTMLResponse(_pages.get_template(template).render(content), status)


def numeral(value: Any, digits: int = 4) -> str:
    """Return a number with few digits, a dash for None, other values as text."""
    if value is None:
        return "–"
    if isinstance(value, bool | int):
        return str(value)
    return number(float(value), digits) if isinstance(value, float | Decimal) else str(value)


def loss_text(loss: float | None, error: float | None) -> str:
    """Return ``mean ± 2 SE`` of a loss, a dash without a loss."""
    if loss is None or not math.isfinite(loss):
        return "–"
    if 0 < loss < 1e-3:
        power = math.floor(math.log10(loss))
        scaled = loss_text(loss / 10**power, None if error is None else error / 10**power)
        return f"({scaled}) · 10{str(power).translate(_RAISED)}"
    return plus_minus(loss, error if error is not None else math.nan)


def moment(value: str | None) -> str:
    """Return a stored time without its fraction of a second."""
    try:
        return datetime.fromisoformat(str(value)).strftime("%Y-%m-%d %H:%M:%S UTC")
    except ValueError:
        return "–"


def duration(seconds: float | None) -> str:
    """Return a duration in ms, s, min or h."""
    if seconds is None or not math.isfinite(seconds):
        return "–"
    if seconds < 1:
        return f"{1000 * seconds:.0f} ms"
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


_pages = Environment(
    loader=FileSystemLoader(FOLDER / "templates"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_pages.filters.update(
    numeral=numeral,
    loss=loss_text,
    moment=moment,
    duration=duration,
    mebibytes=lambda count: "–" if count is None else f"{count / 2**20:.0f} MiB",
    title=environment_title,
    exact=lambda value: f"{value:.10g}",
)
