"""Executors by name, of which those on Ray share one instance of it."""

from __future__ import annotations

from typing import Any

import pytest

from tests.orchestrate.lean_ray import leave_services_out

WORKERS = 2
"""Number of workers of an executor, where the number does not matter."""

ON_RAY = pytest.mark.xdist_group("executors")
"""Mark of the tests that share one Ray."""

RAY = pytest.param("ray", marks=ON_RAY)
WITH_PROCESSES = ("local", RAY)
ALL = ("inprocess", *WITH_PROCESSES)


@pytest.fixture
def shared_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let executors on Ray join one instance in this process, which the first of them starts.

    Its start takes longer than all that a test does with it. A test that undoes ``monkeypatch``
    ends the instance with its executor, and the next test starts another.
    """
    import ray

    from orchestrate.executors.ray import executor

    start = executor._init

    def start_once(address: str, **options: Any) -> None:
        if not ray.is_initialized():
            leave_services_out()
            start(address, **{**options, "num_cpus": WORKERS})

    def disconnect(_: executor.OwnRay, *, lost: bool) -> None:
        assert not lost

    monkeypatch.setattr(executor, "_init", start_once)
    monkeypatch.setattr(executor.OwnRay, "disconnect", disconnect)


@pytest.fixture
def executor(request: pytest.FixtureRequest) -> str:
    """Return the name of an executor, for which there is a Ray if it needs one."""
    name = str(request.param)
    if name == "ray":
        request.getfixturevalue("shared_ray")
    return name
