"""The Job of docker/kubernetes loses nothing, though a pod is evicted every five seconds."""

from __future__ import annotations

import os
import random
import time
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

from orchestrate.runner.worker import FINISHING_SECONDS
from tests.docker.kubernetes import of_kind
from tests.soak.job_controller import JobController, environment_of_pods

TRIALS = 2_000
"""Trials of the drill, unless DOPT_SOAK_TRIALS says how many."""

SECONDS_BETWEEN_EVICTIONS = 5.0
FEWEST_EVICTIONS = 5
LARGEST_SHARE_TWICE = 0.02

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1800)]


def test_evicted_pods_lose_nothing_and_compute_little_twice(
    request: pytest.FixtureRequest, postgresql_url: str, tmp_path: Path
) -> None:
    trials, chance = int(os.environ.get("DOPT_SOAK_TRIALS", TRIALS)), random.Random(3)
    grid = ("env=pendulum", "policy=d_optimal", f"seed=range({trials})")
    job = JobController(
        of_kind("workers", "Job", "dopt-workers"),
        tmp_path,
        environment_of_pods(postgresql_url),
        words_of={
            "register": ("launch", "-m", *grid, "launch.detach=true"),
            "worker": ("orchestrate", "work", "--processes=1", "--memory-gib=1.5"),
        },
    )
    evictions, due = 0, time.monotonic() + SECONDS_BETWEEN_EVICTIONS
    try:
        while job.look():
            working = [pod for pod in job.pods.values() if pod.works and pod.evicted is None]
            if working and time.monotonic() > due:
                chance.choice(working).evict()
                evictions, due = evictions + 1, time.monotonic() + SECONDS_BETWEEN_EVICTIONS
            time.sleep(0.1)
    finally:
        job.close()
    statuses, attempts, longest = outcomes(postgresql_url)
    terminal = request.config.get_terminal_writer()
    terminal.line(
        f"\n{trials:,} trials, {evictions} evictions, pods ended with {dict(job.ended)}, "
        f"attempts {attempts}, longest trial {longest:.2f} s"
    )
    assert evictions >= FEWEST_EVICTIONS
    assert statuses == {"done": trials}
    assert attempts["done"] == trials
    assert attempts.keys() <= {"done", "released", "lost"}
    # Trials that run are finished within this time; those that are handed back had not begun.
    assert longest < FINISHING_SECONDS
    assert attempts.get("lost", 0) <= LARGEST_SHARE_TWICE * trials


def outcomes(url: str) -> tuple[dict[str, int], dict[str, int], float]:
    """Return the trials by status, the attempts by outcome, and the longest wall time [s]."""
    engine = create_engine(url)
    with engine.connect() as connection:

        def table(query: str) -> dict[str, int]:
            return {str(key): int(n) for key, n in connection.execute(text(query))}

        statuses = table("SELECT status, count(*) FROM trial GROUP BY 1")
        attempts = table("SELECT outcome, count(*) FROM attempt GROUP BY 1")
        longest = connection.execute(text("SELECT max(wall_seconds) FROM attempt")).scalar_one()
    engine.dispose()
    return statuses, attempts, float(longest)
