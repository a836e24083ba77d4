"""PostgreSQL goes away in mid-run: the launch waits, and gives up in a sentence."""

from __future__ import annotations

import random
import time
from collections.abc import Callable

import pytest

from tests.orchestrate.faults.laboratory import Laboratory
from tests.orchestrate.faults.servers import Server
from tests.waiting import PATIENCE_SECONDS, until

pytestmark = pytest.mark.xdist_group("postgresql-restarts")


@pytest.fixture
def laboratory(postgresql_url: str, laboratory_at: Callable[..., Laboratory]) -> Laboratory:
    return laboratory_at(postgresql_url, trials=80)


def test_connections_that_end_at_random_moments_cost_nothing(
    laboratory: Laboratory, server: Server
) -> None:
    moments = random.Random(0)
    done = ended = 0
    laboratory.gate.let(40)
    with laboratory.launched() as launched:
        while launched.process.is_alive():
            until(lambda: laboratory.count() > done or not launched.process.is_alive())  # noqa: B023
            done = laboratory.count()
            time.sleep(moments.uniform(0.0, 0.3))
            ended += server.terminate_backends()
            if ended:
                laboratory.gate.open()
        assert launched.end() == 0, launched.errors
    assert ended > 0
    laboratory.check()


@pytest.mark.parametrize("mode", ["fast", "immediate"])
def test_a_restart_of_the_server_costs_nothing(
    laboratory: Laboratory, server: Server, mode: str
) -> None:
    settings = {"patience": PATIENCE_SECONDS}
    with laboratory.launched(settings=settings) as launched:
        for done in (5, 30):
            laboratory.gate.let(25)
            launched.until(lambda done=done: laboratory.count() >= done)  # type: ignore[misc]
            server.restart(mode)
        laboratory.gate.open()
        assert launched.end() == 0, launched.errors
    laboratory.check()
    assert laboratory.count("status = 'running'") == 0


def test_a_server_that_stays_away_ends_the_launch_and_a_rerun_completes(
    laboratory: Laboratory, server: Server
) -> None:
    laboratory.gate.let(20)
    with laboratory.launched(settings={"patience": 2}) as launched:
        launched.until(lambda: laboratory.count() >= 5)
        server.stop()
        try:
            assert launched.end() == 75, launched.errors
        finally:
            server.start()
    assert launched.errors.count("error:") == 1
    assert "server runs and answers" in launched.errors
    assert "Traceback" not in launched.errors
    assert 5 <= laboratory.count() < laboratory.order.trials
    laboratory.check_whole()
    laboratory.end_lease(launched)
    laboratory.complete()
