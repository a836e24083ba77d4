"""Registration, claims and their way back: one contract, every database."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from dopt.errors import SpecificationError
from orchestrate.records import Failure
from orchestrate.store import OpenTrial, Reader, Store
from tests.orchestrate.store.conftest import Database
from tests.orchestrate.store.databases import execute
from tests.orchestrate.store.fakes import (
    FAILURE,
    HORIZON,
    LAUNCH,
    RUN,
    Spec,
    assessed,
    diverged,
    result,
)
from tests.orchestrate.store.processes import eight_open, hear, hold_claims, kill, running

OpenStore = Callable[..., Store]
SPECS = [Spec(seed) for seed in range(5)]


# Registration


def test_a_registration_keeps_the_order_and_counts_each_trial_once(db: Database) -> None:
    specs = [Spec(seed) for seed in (3, 1, 2, 1)]
    first = db.store.register(db.launch, iter(specs))
    assert first.todo == [spec.trial_key for spec in specs[:3]]
    assert first.total == 3
    rows = db.rows("SELECT * FROM trial ORDER BY trial_id")
    assert db.store.register(db.launch, specs) == first
    assert db.rows("SELECT * FROM trial ORDER BY trial_id") == rows
    assert db.store.register(db.launch, []).total == 0


def test_a_registration_counts_every_status(db: Database) -> None:
    done, bad, failed, _ = db.take(*SPECS[:4])
    db.store.commit(done, result(), RUN)
    db.store.commit(bad, diverged(2), RUN)
    db.store.fail(failed, FAILURE, RUN)
    seen = db.store.register(db.store.begin_launch(LAUNCH), SPECS)
    assert (seen.total, seen.done, seen.diverged, seen.failed) == (5, 1, 1, 1)
    assert (seen.cancelled, seen.running_elsewhere) == (0, 1)
    assert seen.todo == [SPECS[4].trial_key]
    assert db.store.register(db.launch, SPECS).running_elsewhere == 0


def test_a_registration_takes_numpy_integers(db: Database) -> None:
    spec = Spec(np.int64(3), width=np.int64(8))  # type: ignore[arg-type]
    db.store.register(db.launch, [spec])
    found = db.rows("SELECT seed, width FROM v_trial WHERE seed = 3 AND width = 8")
    assert found == [(3, 8)]


class OfANotebook(Spec):
    @property
    def config_json(self) -> str:
        return '{"env": {"name": "pendulum"}, "policy": {"_target_": "__main__.Held"}}'


class Incomplete(Spec):
    def columns(self) -> dict[str, str]:
        return {"env": "pendulum"}


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        (OfANotebook(1), SpecificationError, r"policy is of the class __main__\.Held of a noteb"),
        (Incomplete(1), ValueError, "expected env, policy"),
    ],
)
def test_a_registration_refuses_what_no_worker_can_run(
    db: Database, spec: Spec, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        db.store.register(db.launch, [Spec(1), spec])
    assert db.rows("SELECT * FROM trial") == []


# Claims


def test_claims_go_to_one_launch_only(db: Database, open_store: OpenStore) -> None:
    keys = db.store.register(db.launch, SPECS[:4]).todo
    mine = db.store.claim(db.launch, [keys[2], keys[0]])
    assert [claim.trial_key for claim in mine] == [keys[2], keys[0]]
    other = open_store()
    theirs = other.claim(other.begin_launch(LAUNCH), keys)
    assert [claim.trial_key for claim in theirs] == [keys[1], keys[3]]
    for wanted in (keys, ["0" * 64], []):
        assert db.store.claim(db.launch, wanted) == []


def test_claims_are_released_one_by_one_and_end_with_their_launch(db: Database) -> None:
    one, two, _ = db.take(*SPECS[:3])
    assert db.store.release(db.launch, [one.trial_key]) == 1
    assert db.store.commit(two, result(), RUN)
    assert not db.store.commit(one, result(), RUN)
    db.store.end_launch(db.launch, "interrupted")
    assert db.rows("SELECT state, ended IS NOT NULL FROM launch") == [("interrupted", True)]
    rows = db.rows("SELECT r.status, a.outcome FROM trial r JOIN attempt a USING (trial_id)")
    assert sorted(rows) == [("done", "done"), *[("pending", "released")] * 2]


def test_a_launch_that_begins_again_is_one_launch_and_alive(
    db: Database, open_store: OpenStore
) -> None:
    """Its answer was lost, and others have taken it for dead meanwhile."""
    token = db.store.new_token()
    launch = db.store.begin_launch(LAUNCH, token)
    execute(db.url, f"UPDATE launch SET state = 'lost', ended = started WHERE launch_id = {launch}")
    assert db.store.begin_launch(LAUNCH, token) == launch
    states = db.rows("SELECT state, ended FROM launch ORDER BY launch_id")
    assert states == [("running", None)] * 2
    assert open_store().recover() == 0
    assert db.rows("SELECT state, ended FROM launch ORDER BY launch_id") == states


def test_a_launch_ends_in_a_known_state(db: Database) -> None:
    with pytest.raises(ValueError, match="give done, failed, interrupted, lost"):
        db.store.end_launch(db.launch, "fine")
    with pytest.raises(ValueError, match="no launch 99"):
        db.store.end_launch(99, "done")


# The way back


def test_recovery_leaves_a_living_launch_and_what_has_an_outcome_alone(
    db: Database, open_store: OpenStore
) -> None:
    done, failed, claim = db.take(*SPECS[:3])
    db.store.commit(done, result(), RUN)
    db.store.fail(failed, FAILURE, RUN)
    assert open_store().recover() == 0
    assert db.store.commit(claim, result(), RUN)
    db.store.end_launch(db.launch, "done")
    assert db.store.recover() == 0
    assert sorted(db.rows("SELECT status FROM trial")) == [("done",), ("done",), ("failed",)]


@pytest.mark.parametrize(
    ("status", "among", "expected"),
    [("failed", None, [1, 3]), ("diverged", None, [2]), ("all", None, [1, 2, 3]),
     ("failed", [1, 2], [1])],
)  # fmt: skip
def test_a_retry_takes_back_what_was_not_done(
    db: Database, status: str, among: list[int] | None, expected: list[int]
) -> None:
    done, failed, bad, also = db.take(*SPECS[:4])
    db.store.commit(done, result(), RUN)
    for claim in (failed, also):
        db.store.fail(claim, FAILURE, RUN)
    db.store.commit(bad, diverged(2), RUN)
    keys = None if among is None else [SPECS[seed].trial_key for seed in among]
    assert db.store.retry(status, keys) == len(expected)
    todo = db.store.register(db.launch, SPECS[:4]).todo
    assert todo == [SPECS[seed].trial_key for seed in expected]
    with pytest.raises(ValueError, match="by the status 'done': give failed"):
        db.store.retry("done")


def test_a_retry_forgets_a_divergence(db: Database) -> None:
    (claim,) = db.take(Spec())
    kept = tuple(row for row in assessed().assessments if row.t == 0)
    db.store.commit(claim, replace(diverged(2), assessments=kept), RUN)
    db.store.retry("diverged")
    for table in ("assessment", "step", "trajectory"):
        assert db.rows(f"SELECT * FROM {table}") == []
    assert db.store.commit(*db.take(Spec()), result(), RUN)
    (row,) = db.reader.trials(Spec().config_key)
    assert (row.status, row.attempt, row.diverged_at) == ("done", 2, None)


def test_eight_processes_create_one_database(url: str, tmp_path: Path) -> None:
    """Many times over where a file is made."""
    files = [f"sqlite:///{tmp_path}/{i}.db" for i in range(4)] if "sqlite" in url else []
    eight_open([url, *files])
    for one in (url, *files):
        with Store.open(one) as store:
            assert store.begin_launch(LAUNCH) == 9


def test_only_the_claims_of_the_dead_are_freed(db: Database) -> None:
    with running(hold_claims, db.url, 3) as (process, pipe):
        theirs = hear(pipe)
        (mine,) = db.take(Spec(99))
        assert db.store.recover() == 0
        kill(process)
        dead = f"launch_id <> {mine.launch} AND lease_until > 0"
        execute(db.url, f"UPDATE launch SET lease_until = 0 WHERE {dead}")
        assert db.store.recover() == 3  # a lock of the kernel ends by itself
    assert db.store.commit(mine, result(), RUN)
    assert not db.store.commit(theirs[0], result(), RUN)


# What is open


def open_trials(db: Database, most: int = 100) -> list[OpenTrial]:
    """Return the open trials of the configuration of which a launch has registered most."""
    config = max(db.store.open_configs(db.launch), key=lambda one: one.pending)
    return db.store.open_trials(db.launch, config.config_id, most, losses=3)


@pytest.fixture
def lose_launch(db: Database, open_store: OpenStore) -> Callable[[list[str]], None]:
    """Return a function that lets a launch that holds some trials end without a word."""

    def end_one(keys: list[str]) -> None:
        lost = open_store()
        launch = lost.begin_launch(LAUNCH)
        lost.claim(launch, keys)
        lost.close()
        execute(db.url, f"UPDATE launch SET lease_until = 0 WHERE launch_id = {launch}")
        assert db.store.recover() == len(keys)

    return end_one


def test_a_configuration_with_its_counts_and_times(db: Database) -> None:
    db.store.register(db.launch, [*SPECS[:4], Spec(0, policy="other")])
    one, two, _ = db.take(*SPECS[:3])
    db.store.commit(one, result(), RUN)
    db.store.commit(two, diverged(2), replace(RUN, wall_seconds=1.5))
    first, second = sorted(db.store.open_configs(db.launch), key=lambda config: -config.running)
    assert first.config_key == SPECS[0].config_key
    assert first.config_json == SPECS[0].config_json
    assert (first.pending, first.running) == (1, 1)
    assert (first.mean_seconds, first.max_seconds) == (1.0, 1.5)
    assert (second.pending, second.running, second.mean_seconds) == (1, 0, None)


def test_a_finished_configuration_is_not_open(db: Database) -> None:
    db.store.commit(*db.take(Spec()), result(), RUN)
    assert db.store.open_configs(db.launch) == []


def test_pending_trials_of_one_configuration_and_how_many_killed_a_process(db: Database) -> None:
    db.store.register(db.launch, [*SPECS[:4], Spec(0, policy="other")])
    db.take(*SPECS[:2])
    db.store.release(db.launch, [SPECS[1].trial_key], "killed")
    expected = {(spec.trial_key, spec.seed, int(spec.seed == 1)) for spec in SPECS[1:4]}
    assert {(one.trial_key, one.seed, one.crashes) for one in open_trials(db)} == expected
    assert len(open_trials(db, most=2)) == 2


def test_a_trial_whose_launches_were_lost_is_suspect(
    db: Database, lose_launch: Callable[[list[str]], None]
) -> None:
    keys = db.store.register(db.launch, SPECS[:4]).todo
    lose_launch(keys[:2])
    for _ in range(2):
        lose_launch(keys[1:2])
    assert {one.seed for one in open_trials(db)} == {0, 2, 3}
    (suspect,) = db.store.suspects(db.launch, losses=3)
    assert (suspect.seed, suspect.lone_losses) == (1, 2)
    (claim,) = db.store.claim(db.launch, keys[1:2])
    db.store.fail(claim, Failure("WorkerLost", "lost", "", "node lost"), RUN)
    db.store.retry("failed", keys)
    assert db.store.suspects(db.launch, losses=3) == [], "it has a new chance"
    assert {one.seed for one in open_trials(db)} == {0, 1, 2, 3}


# What a reader sees of it


def test_a_launch_tells_where_it_came_from(store: Store, reader: Reader) -> None:
    first = store.begin_launch(LAUNCH)
    second = store.begin_launch(replace(LAUNCH, git_commit=None, git_dirty=None, pid=3))
    store.end_launch(second, "done")
    one, two = reader.launches()
    assert (one.launch_id, one.state, one.alive, one.ended) == (first, "running", True, None)
    assert (two.launch_id, two.state, two.alive, two.git_dirty) == (second, "done", False, None)
    assert one.started <= two.started <= str(two.ended)
    shown = {name: value for name, value in asdict(one).items() if hasattr(LAUNCH, name)}
    assert json.loads(json.dumps(shown)) == json.loads(json.dumps(asdict(LAUNCH)))


def test_a_dead_launch_says_running_but_does_not_live(open_store: OpenStore, url: str) -> None:
    dead = open_store()
    dead.begin_launch(LAUNCH)
    dead.close()
    execute(url, "UPDATE launch SET lease_until = 0")  # long ago, on PostgreSQL
    with Reader.open(url) as reader:
        (launch,) = reader.launches()
    assert (launch.state, launch.alive) == ("running", False)


def test_all_reads_of_a_moment_agree(db: Database) -> None:
    early, late = db.take(Spec(0), Spec(1))
    db.store.commit(early, result(0), RUN)
    with db.reader.moment() as moment:
        assert moment.configs()[0].n_done == 1
        db.store.commit(late, result(1), RUN)
        assert moment.configs()[0].n_done == 1
        assert len(moment.curves(Spec().config_key).values) == 1
        assert len(moment.rows("SELECT t FROM step")) == HORIZON
    assert db.reader.configs()[0].n_done == 2


def test_rows_come_in_batches_that_can_be_left_early(db: Database) -> None:
    for claim in db.take(Spec(0), Spec(1)):
        db.store.commit(claim, result(), RUN)
    sql = "SELECT trial_id, t FROM step WHERE t > :t ORDER BY trial_id, t"
    assert [len(rows) for rows in db.reader.batches(5, sql, t=0)] == [5, 5, 2]
    assert list(db.reader.batches(5, sql, t=HORIZON)) == []
    with db.reader.moment() as moment:
        batches = moment.batches(2, "SELECT t FROM step")
        assert len(next(batches)) == 2
        batches.close()
        assert len(moment.rows("SELECT t FROM step")) == 2 * HORIZON
