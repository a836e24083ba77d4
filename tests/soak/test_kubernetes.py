"""The Job of docker/kubernetes loses nothing, though a pod is evicted every five seconds."""

from __future__ import annotations

import os
import random
import time
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

from tests.docker.kubernetes import of_kind
from tests.soak.job_controller import JobController, environment_of_pods

TRIALS = 2_000
"""Trials of the drill, unless DOPT_EVICTION_TRIALS says how many."""

SECONDS_BETWEEN_EVICTIONS = 5.0
LARGEST_SHARE_TWICE = 0.02

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1800)]


def test_evicted_pods_lose_nothing_and_compute_little_twice(
    request: pytest.FixtureRequest, postgresql_url: str, tmp_path: Path
) -> None:
    trials, chance = int(os.environ.get("DOPT_EVICTION_TRIALS", TRIALS)), random.Random(3)
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
    statuses, attempts, in_vain = outcomes(postgresql_url)
    terminal = request.config.get_terminal_writer()
    terminal.line(
        f"\n{trials:,} trials, {evictions} evictions, pods ended with {dict(job.ended)}, "
        f"attempts {attempts}, at most {in_vain} of them begun in vain"
    )
    assert evictions >= trials / 200
    assert statuses == {"done": trials}
    assert attempts["done"] == trials
    assert attempts.keys() <= {"done", "released", "lost"}
    assert in_vain + attempts.get("lost", 0) <= LARGEST_SHARE_TWICE * trials


def outcomes(url: str) -> tuple[dict[str, int], dict[str, int], int]:
    """Return the trials by status, the attempts by outcome, and how many were begun in vain.

    These are at most the first trials of the workers, which load the compiled code: a worker that
    is warned finishes a later one, which takes less than a tenth of a second, and hands back trials
    that have not begun. It runs one at a time.
    """
    engine = create_engine(url)
    with engine.connect() as connection:

        def table(query: str) -> dict[str, int]:
            return {str(key): int(n) for key, n in connection.execute(text(query))}

        statuses = table("SELECT status, count(*) FROM trial GROUP BY 1")
        attempts = table("SELECT outcome, count(*) FROM attempt GROUP BY 1")
        workers = (
            "SELECT launch_id, count(*) FILTER (WHERE outcome = 'done') FROM attempt "
            "GROUP BY launch_id HAVING count(*) FILTER (WHERE outcome = 'released') > 0"
        )
        in_vain = sum(done == 0 for done in table(workers).values())
    engine.dispose()
    return statuses, attempts, in_vain
