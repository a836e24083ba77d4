"""Several processes, and the death of some of them, on every database."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np

from orchestrate.store import Claim, Reader, Store
from tests.orchestrate.store.databases import execute
from tests.orchestrate.store.fakes import HORIZON, LAUNCH, RUN, Spec, result
from tests.orchestrate.store.processes import (
    die_in_commit,
    eight_open,
    hear,
    hold_claims,
    kill,
    run_grid,
    running,
)
from tests.waiting import until

KEY = Spec().config_key


def _recover_from_the_dead(store: Store, url: str, but: int = 0) -> int:
    """Recover when all leases except one launch's have run out; a kernel lock ends by itself."""
    execute(url, f"UPDATE launch SET lease_until = 0 WHERE launch_id <> {but} AND lease_until > 0")
    freed = 0

    def nothing_runs() -> bool:  # later, while the server still undoes what a dead launch did
        nonlocal freed
        freed += store.recover()
        return not execute(url, f"SELECT * FROM trial WHERE owner <> {but}")

    until(nothing_runs)
    return freed


def _is_whole(reader: Reader) -> bool:
    """Return True if each finished trial has all of its rows, and every other one no row."""
    rows = reader.rows(
        "SELECT r.status IN ('done', 'diverged') AS finished, "
        "(SELECT count(*) FROM step s WHERE s.trial_id = r.trial_id) AS steps, "
        "(SELECT count(*) FROM trajectory p WHERE p.trial_id = r.trial_id) AS arrays FROM trial r"
    )
    return all(tuple(row[1:]) == ((HORIZON, 1) if row.finished else (0, 0)) for row in rows)


def test_eight_processes_create_one_database(url: str, open_store: Callable[..., Store]) -> None:
    eight_open([url])
    assert open_store().begin_launch(LAUNCH) == 9


def test_two_launches_share_a_grid(url: str) -> None:
    n = 60
    with ExitStack() as stack:
        pipes = [stack.enter_context(running(run_grid, url, n))[1] for _ in range(2)]
        for pipe in pipes:
            hear(pipe)
        for pipe in pipes:
            pipe.send("now")
        shares = [hear(pipe) for pipe in pipes]
    assert sum(shares) == n
    with Reader.open(url) as reader:
        assert _is_whole(reader)
        assert len(reader.rows("SELECT * FROM attempt")) == n


def test_death_in_a_commit_leaves_no_partial_curve(store: Store, reader: Reader, url: str) -> None:
    with running(die_in_commit, url) as (process, pipe):
        assert hear(pipe) == "half"
        kill(process)
    assert _is_whole(reader)
    assert _recover_from_the_dead(store, url) == 1
    assert [row.status for row in reader.trials(KEY)] == ["done", "pending"]
    (attempt,) = reader.rows("SELECT outcome FROM attempt a WHERE outcome <> 'done'")
    assert attempt.outcome == "lost"
    launch = store.begin_launch(LAUNCH)
    (claim,) = store.claim(launch, [Spec(1).trial_key])
    assert store.commit(claim, result(claim.trial_id), RUN)
    np.testing.assert_array_equal(
        reader.curves(KEY).values, [result(trial_id).loss for trial_id in (1, 2)]
    )


def test_death_at_any_moment_is_made_good(store: Store, reader: Reader, url: str) -> None:
    moments = random.Random(0)
    for _ in range(3):
        with running(run_grid, url, 400) as (process, pipe):
            hear(pipe)
            pipe.send("now")
            time.sleep(moments.uniform(0.0, 0.2))
            kill(process)
        assert _is_whole(reader)
    _recover_from_the_dead(store, url)
    with running(run_grid, url, 400) as (_, pipe):
        hear(pipe)
        pipe.send("now")
        hear(pipe)
    assert _is_whole(reader)
    losses = [result(trial_id).loss for trial_id in range(1, 401)]
    np.testing.assert_array_equal(reader.curves(KEY).values, losses)


def test_only_the_claims_of_the_dead_are_freed(
    store: Store, url: str, take: Callable[..., list[Claim]]
) -> None:
    with running(hold_claims, url, 3) as (process, pipe):
        theirs = hear(pipe)
        (mine,) = take(Spec(99))
        assert store.recover() == 0
        kill(process)
        assert _recover_from_the_dead(store, url, mine.launch) == 3
    assert store.commit(mine, result(), RUN)
    assert not store.commit(theirs[0], result(), RUN)
