"""Thousands of trials with a fault every few seconds end as if undisturbed."""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import pytest
from tabulate import tabulate

from tests.orchestrate.faults.conftest import (  # noqa: F401  fixtures, which pytest finds here
    laboratory_at,
    postgresql_url,
    server,
    undisturbed,
)
from tests.orchestrate.faults.laboratory import Laboratory, Server, preempt
from tests.orchestrate.faults.test_workers import register
from tests.soak.disturbances import ON_POSTGRESQL, ON_SQLITE, Supervisor

At = Callable[..., Laboratory]

TRIALS = int(os.environ.get("DOPT_SOAK_TRIALS", "10000"))
"""Trials on each database; workers that pull run half of them."""

SETTINGS = {"lease": 6, "patience": 5, "chunk_seconds": 0.5}
FEWEST_FAULTS = 10

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1800)]


@pytest.mark.parametrize("database", ["sqlite", "postgresql"])
def test_a_grid_survives_everything(
    request: pytest.FixtureRequest,
    laboratory_at: At,  # noqa: F811
    tell: Callable[[str], None],
    database: str,
) -> None:
    server: Server | None = None  # noqa: F811
    disturbances = ON_SQLITE
    if database == "postgresql":
        server, disturbances = request.getfixturevalue("server"), ON_POSTGRESQL
    url = request.getfixturevalue(f"{database}_url")
    laboratory = laboratory_at(url, TRIALS, seconds=0.005, settings=SETTINGS)
    supervisor = Supervisor(laboratory, server, disturbances, random.Random(1))
    try:
        supervisor.run()
        laboratory.check()
    finally:
        tell(f"{TRIALS:,} trials on {database}, {supervisor.starts} launches")
        tell(supervisor.table())
        headers = ["outcome of an attempt", "times"]
        tell(tabulate(attempts(laboratory), headers=headers, tablefmt="github"))
    faults = sum(seen.total() for seen in supervisor.seen.values())
    assert faults >= min(FEWEST_FAULTS, TRIALS // 500)
    assert laboratory.count("status = 'failed'") == 0


def test_workers_survive_a_preemption_every_second_or_two(
    url: str,
    laboratory_at: At,  # noqa: F811
    tell: Callable[[str], None],
) -> None:
    laboratory = laboratory_at(url, TRIALS // 2, seconds=0.05)
    register(laboratory)
    sent = preempt(laboratory, workers=3, every=50, chance=random.Random(2), lease=2.0)
    laboratory.check()
    assert laboratory.count("status = 'failed'") == 0
    tell(f"{TRIALS // 2:,} trials, signals {dict(sent)}, attempts {dict(attempts(laboratory))}")
    assert sent.total() >= 10


def attempts(laboratory: Laboratory) -> list[tuple[str, int]]:
    sql = "SELECT coalesce(outcome, 'running'), count(*) FROM attempt GROUP BY 1 ORDER BY 1"
    return [(str(row[0]), int(row[1])) for row in laboratory.query(sql)]
