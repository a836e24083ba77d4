"""Databases made once for the tests that only read."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from orchestrate.store import Reader
from tests.analysis.synthetic import fill, make_grid

SHORT = {"env": {"horizon": 60}}


@pytest.fixture(scope="session")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a complete grid of three systems and five policies, one trial of which diverged."""
    address = f"sqlite:///{tmp_path_factory.mktemp('complete')}/results.db"
    specs = make_grid(("pendulum", "cartpole", "quadrotor"), seeds=range(5), **SHORT)
    lost = [s for s in specs if (s.system.name, s.policy.name, s.seed) == ("cartpole", "random", 2)]
    fill(address, specs, diverged={lost[0].trial_key: 20})
    return address


@pytest.fixture
def reader(url: str) -> Iterator[Reader]:
    with Reader.open(url) as opened:
        yield opened
