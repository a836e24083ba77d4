"""Folders of the repository that tests read, and the environment of programs that they start."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"
EXAMPLE = ROOT / "docs" / "example"


def loaded(path: Path) -> ModuleType:
    """Run a file as a module of its own, which no other import finds, and return it."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def without_coverage() -> dict[str, str]:
    """Return an environment in which `make coverage` does not measure a program."""
    return {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE")}
