"""Ten thousand trials with a fault every few seconds end as if nothing had happened."""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import pytest
from tabulate import tabulate

from tests.orchestrate.faults.laboratory import Laboratory
from tests.orchestrate.faults.servers import Server
from tests.soak.disturbances import ON_POSTGRESQL, ON_SQLITE
from tests.soak.supervisor import Supervisor

TRIALS = 10_000
"""Trials on each database, unless DOPT_SOAK_TRIALS says how many."""

SETTINGS = {"lease": 6, "patience": 5, "chunk_seconds": 0.5}
FEWEST_FAULTS = 10

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1800)]


@pytest.mark.parametrize("database", ["sqlite", "postgresql"])
def test_a_grid_survives_everything(
    request: pytest.FixtureRequest, laboratory_at: Callable[..., Laboratory], database: str
) -> None:
    trials = int(os.environ.get("DOPT_SOAK_TRIALS", TRIALS))
    url = request.getfixturevalue(f"{database}_url")
    server: Server | None = None
    disturbances = ON_SQLITE
    if database == "postgresql":
        server, disturbances = request.getfixturevalue("server"), ON_POSTGRESQL
    laboratory = laboratory_at(url, trials, seconds=0.005, settings=SETTINGS)
    supervisor = Supervisor(laboratory, server, disturbances, random.Random(1))
    try:
        supervisor.run()
        laboratory.check()
    finally:
        _tell(request, database, supervisor)
    faults = sum(seen.total() for seen in supervisor.seen.values())
    assert faults >= min(FEWEST_FAULTS, trials // 500)
    assert laboratory.count("status = 'failed'") == 0


def _tell(request: pytest.FixtureRequest, database: str, supervisor: Supervisor) -> None:
    attempts = supervisor.laboratory.query(
        "SELECT coalesce(outcome, 'running'), count(*) FROM attempt GROUP BY 1 ORDER BY 1"
    )
    terminal = request.config.get_terminal_writer()
    terminal.line()
    terminal.line(
        f"{supervisor.laboratory.order.trials:,} trials on {database}, {supervisor.starts} launches"
    )
    terminal.line(supervisor.table())
    terminal.line(tabulate(attempts, headers=["outcome of an attempt", "times"], tablefmt="github"))
