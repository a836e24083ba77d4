"""Text and JSON on the standard output."""

from __future__ import annotations

import base64
import json
import math
import sys
from collections.abc import Mapping
from decimal import Decimal
from typing import Any

import numpy as np

from orchestrate.cli_parser import tell


def say(text: str) -> None:
    """Print a line and flush it."""
    tell(sys.stdout, f"{text}\n")


def say_json(document: Any) -> None:
    """Print one JSON document; numbers that are not finite are null, bytes are base64."""
    say(json.dumps(jsonable(document), indent=2, allow_nan=False))


def jsonable(value: Any) -> Any:
    """Return the value in the types of JSON."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(one) for key, one in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [jsonable(one) for one in value]
    if isinstance(value, Decimal):
        return int(value) if value == value.to_integral_value() else jsonable(float(value))
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes | memoryview):
        return base64.b64encode(value).decode()
    return value if isinstance(value, bool | int | str | None) else str(value)
