"""Names of the executors, for tests that run once for each."""

from __future__ import annotations

import pytest

WORKERS = 2
"""Number of workers of an executor, where the number does not matter."""

ON_RAY = pytest.mark.xdist_group("executors")
"""Mark of the tests that share one Ray."""

RAY = pytest.param("ray", marks=ON_RAY)
WITH_PROCESSES = ("local", RAY)
ALL = ("inprocess", *WITH_PROCESSES)
