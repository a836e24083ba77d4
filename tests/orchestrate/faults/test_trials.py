"""A trial that kills its worker, takes all memory or never ends: it fails alone, with its cause."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.orchestrate.faults.laboratory import Laboratory
from tests.orchestrate.faults.trials import BROKEN_SEED

RAY = pytest.mark.xdist_group("ray")
TROUBLES = {
    "kill": ("killed", {}),
    "hang": ("timeout", {"timeout": 10}),
    "memory": ("out of memory", {"memory_gib": 1}),
}


@pytest.mark.parametrize(
    ("executor", "trouble"),
    [
        *(("local", trouble) for trouble in TROUBLES),
        *(pytest.param("ray", trouble, marks=RAY) for trouble in ("kill", "hang")),
    ],
)
def test_it_fails_alone_and_a_retry_completes(
    sqlite_url: str, laboratory_at: Callable[..., Laboratory], executor: str, trouble: str
) -> None:
    cause, settings = TROUBLES[trouble]
    laboratory = laboratory_at(sqlite_url, executor=executor, settings=settings, seconds=0.02)
    with laboratory.launched(trouble=trouble) as launched:
        assert launched.end() == 1, launched.said + launched.errors
    laboratory.check(but=BROKEN_SEED)
    assert laboratory.query("SELECT seed, status, cause FROM v_failures") == [
        (BROKEN_SEED, "failed", cause)
    ]
    assert "1 failed" in launched.said
    assert laboratory.count(f"attempt > 2 AND seed <> {BROKEN_SEED}") == 0
    with laboratory.launched() as again:
        assert again.end() == 1, again.said
    assert "nothing to run" in again.said
    laboratory.complete(settings={**settings, "retry": "failed"}, executor="local")


def test_a_deadly_trial_has_two_attempts_alone(
    url: str, laboratory_at: Callable[..., Laboratory]
) -> None:
    laboratory = laboratory_at(url, seconds=0.02)
    with laboratory.launched(trouble="kill") as launched:
        assert launched.end() == 1, launched.said + launched.errors
    laboratory.check(but=BROKEN_SEED)
    ends = laboratory.query(
        "SELECT a.outcome, a.cause FROM attempt a JOIN trial r ON r.trial_id = a.trial_id "
        f"WHERE r.seed = {BROKEN_SEED} ORDER BY a.attempt"
    )
    # Two alone, and one in a chunk unless it was alone from the start.
    assert len(ends) in (2, 3)
    assert ends == [("released", "killed")] * (len(ends) - 1) + [("failed", "killed")]
