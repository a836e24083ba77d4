"""Folders of the repository that tests read, and the environment of programs that they start."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"
EXAMPLE = ROOT / "docs" / "example"


def without_coverage() -> dict[str, str]:
    """Return an environment in which `make coverage` does not measure a program."""
    return {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE")}
