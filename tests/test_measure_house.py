"""Lines of code as the measurement counts them."""

from __future__ import annotations

from tests.measure_house import code_lines

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
