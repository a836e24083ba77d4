"""Skip of tests on machines that lack something, or their failure where it is required."""

from __future__ import annotations

import os

import pytest


def unavailable(message: str) -> None:
    """Skip the test, or fail it where DOPT_REQUIRE_MACHINES=1."""
    if os.environ.get("DOPT_REQUIRE_MACHINES") == "1":
        pytest.fail(message)
    pytest.skip(message)
