"""Tools of the tests: the size of the project, the mode of Hydra, the distribution over workers."""

from __future__ import annotations

import pytest
import yaml

from tests.measure_house import code_lines
from tests.paths import CONF, EXAMPLE, ROOT

MODULE = '''"""Docstring
of two lines."""

import os
from sys import (
    path,
)

NAMES = (  # two lines, and a comment
    "a")
"""Text below a name."""


def function():
    """Docstring."""
    # A comment.
    text = """one
two"""
    return text
'''


def test_imports_comments_blank_lines_and_docstrings_are_no_code() -> None:
    assert code_lines(MODULE) == 6


def test_no_file_of_the_project_sets_the_mode_of_hydra() -> None:
    folders = [CONF, EXAMPLE / "conf", ROOT / "tests" / "machines" / "conf"]
    files = [path for folder in folders for path in sorted(folder.rglob("*.yaml"))]
    assert len(files) > 50
    for path in files:
        settings = (yaml.safe_load(path.read_text()) or {}).get("hydra") or {}
        assert "mode" not in settings, path


@pytest.mark.xdist_group("alone")
def test_a_group_is_known_to_the_scheduler(request: pytest.FixtureRequest) -> None:
    """Where pytest and pytest-xdist do not fit, each worker starts what a group shares."""
    grouped = getattr(request.config.option, "loadgroup", False)
    assert request.node.nodeid.endswith("@alone") == grouped
