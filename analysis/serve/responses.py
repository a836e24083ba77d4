"""Responses: content rendered as JSON, CSV or an HTML page, and the number formats of pages."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from starlette.responses import HTMLResponse, Response

from analysis.formatting import number, plus_minus
from analysis.line_styles import environment_title

FOLDER = Path(__file__).parent


RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


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
        return f"({scaled}) · 10{str(power).translate(RAISED)}"
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


def size(count: float | None) -> str:
    """Return a number of bytes in B, KiB, MiB or GiB."""
    if count is None:
        return "–"
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"


def named(environments: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """Return the environments with their titles."""
    return [(one["env"], environment_title(one["env"])) for one in environments]


def shortened(text: str) -> str:
    """Return a number of a CSV file with few digits, any other text unchanged."""
    try:
        return numeral(float(text)) if not text.lstrip("-").isdigit() else text
    except ValueError:
        return text


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
    size=size,
    title=environment_title,
    named=named,
    shortened=shortened,
    exact=lambda value: f"{value:.10g}",
)
