"""Registration, claims and their way back: one contract, every database."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import pytest

from dopt.errors import SpecificationError
from orchestrate.records import Failure
from orchestrate.store import Claim, Reader, Store
from tests.orchestrate.store.databases import execute
from tests.orchestrate.store.fakes import HORIZON, LAUNCH, RUN, Spec, assessed, diverged, result

OpenStore = Callable[..., Store]
Take = Callable[..., list[Claim]]
FAILURE = Failure("ValueError", "no", "Traceback: no")


class TestRegistration:
    def test_todo_keeps_the_order_and_counts_each_trial_once(
        self, store: Store, launch: int
    ) -> None:
        specs = [Spec(seed) for seed in (3, 1, 2, 1)]
        registration = store.register(launch, specs)
        assert registration.todo == [spec.trial_key for spec in specs[:3]]
        assert registration.total == 3

    def test_again_changes_nothing(self, store: Store, launch: int, reader: Reader) -> None:
        specs = [Spec(seed, policy=policy) for policy in ("a", "b") for seed in range(3)]
        first = store.register(launch, iter(specs))
        rows = reader.rows("SELECT * FROM trial ORDER BY trial_id")
        assert store.register(launch, specs) == first
        assert reader.rows("SELECT * FROM trial ORDER BY trial_id") == rows

    def test_counts_every_status(self, store: Store, launch: int, take: Take) -> None:
        specs = [Spec(seed) for seed in range(5)]
        done, bad, failed, _ = take(*specs[:4])
        store.commit(done, result(), RUN)
        store.commit(bad, diverged(2), RUN)
        store.fail(failed, FAILURE, RUN)
        other = store.begin_launch(LAUNCH)
        seen = store.register(other, specs)
        assert (seen.total, seen.done, seen.diverged, seen.failed) == (5, 1, 1, 1)
        assert (seen.cancelled, seen.running_elsewhere) == (0, 1)
        assert seen.todo == [specs[4].trial_key]
        assert store.register(launch, specs).running_elsewhere == 0

    def test_takes_numpy_integers(self, store: Store, launch: int, reader: Reader) -> None:
        spec = Spec(np.int64(3), width=np.int64(8))  # type: ignore[arg-type]
        store.register(launch, [spec])
        (row,) = reader.rows("SELECT seed, width FROM v_trial WHERE seed = 3 AND width = 8")
        assert tuple(row) == (3, 8)

    def test_of_an_empty_grid(self, store: Store, launch: int) -> None:
        assert store.register(launch, []).total == 0

    def test_refuses_a_class_that_no_worker_can_import(
        self, store: Store, launch: int, reader: Reader
    ) -> None:
        class Typed(Spec):
            @property
            def config_json(self) -> str:
                return '{"env": {"name": "pendulum"}, "policy": {"_target_": "__main__.Held"}}'

        message = r"policy is of the class __main__\.Held of a notebook, .*: put it into a file"
        with pytest.raises(SpecificationError, match=message):
            store.register(launch, [Spec(1), Typed(1)])
        assert reader.rows("SELECT * FROM trial") == []

    def test_refuses_a_configuration_without_its_columns(self, store: Store, launch: int) -> None:
        class Incomplete(Spec):
            def columns(self) -> dict[str, str]:
                return {"env": "pendulum"}

        with pytest.raises(ValueError, match="expected env, policy"):
            store.register(launch, [Incomplete()])


class TestClaims:
    def test_go_to_one_launch_only(self, store: Store, open_store: OpenStore, launch: int) -> None:
        keys = store.register(launch, [Spec(seed) for seed in range(4)]).todo
        mine = store.claim(launch, [keys[2], keys[0]])
        assert [claim.trial_key for claim in mine] == [keys[2], keys[0]]
        other = open_store()
        theirs = other.claim(other.begin_launch(LAUNCH), keys)
        assert [claim.trial_key for claim in theirs] == [keys[1], keys[3]]
        assert store.claim(launch, keys) == []

    def test_of_unknown_trials_are_none(self, store: Store, launch: int) -> None:
        assert store.claim(launch, ["0" * 64]) == []
        assert store.claim(launch, []) == []

    def test_are_released_one_by_one(self, store: Store, launch: int, take: Take) -> None:
        one, two = take(Spec(1), Spec(2))
        assert store.release(launch, [one.trial_key]) == 1
        assert store.commit(two, result(), RUN)
        assert not store.commit(one, result(), RUN)

    def test_end_with_their_launch(
        self, store: Store, launch: int, take: Take, reader: Reader
    ) -> None:
        take(Spec())
        store.end_launch(launch, "interrupted")
        (row,) = reader.rows("SELECT state, ended IS NOT NULL FROM launch")
        assert tuple(row) == ("interrupted", True)
        (row,) = reader.rows(
            "SELECT r.status, a.outcome FROM trial r JOIN attempt a USING (trial_id)"
        )
        assert tuple(row) == ("pending", "released")

    def test_a_launch_ends_in_a_known_state(self, store: Store, launch: int) -> None:
        with pytest.raises(ValueError, match="give done, failed, interrupted, lost"):
            store.end_launch(launch, "fine")
        with pytest.raises(ValueError, match="no launch 99"):
            store.end_launch(99, "done")


class TestRecovery:
    def test_leaves_a_living_launch_alone(
        self, store: Store, take: Take, open_store: OpenStore
    ) -> None:
        (claim,) = take(Spec())
        assert open_store().recover() == 0
        assert store.commit(claim, result(), RUN)

    def test_leaves_other_statuses_alone(
        self, store: Store, launch: int, take: Take, reader: Reader
    ) -> None:
        done, failed = take(Spec(1), Spec(2))
        store.commit(done, result(), RUN)
        store.fail(failed, FAILURE, RUN)
        store.end_launch(launch, "done")
        assert store.recover() == 0
        assert [tuple(r) for r in reader.rows("SELECT status FROM trial ORDER BY seed")] == [
            ("done",),
            ("failed",),
        ]


class TestRetry:
    @pytest.mark.parametrize(
        ("status", "expected"), [("failed", [1]), ("diverged", [2]), ("all", [1, 2])]
    )
    def test_takes_back_what_was_not_done(
        self, store: Store, launch: int, take: Take, status: str, expected: list[int]
    ) -> None:
        specs = [Spec(seed) for seed in range(3)]
        done, failed, bad = take(*specs)
        store.commit(done, result(), RUN)
        store.fail(failed, FAILURE, RUN)
        store.commit(bad, diverged(2), RUN)
        assert store.retry(status) == len(expected)
        assert store.register(launch, specs).todo == [specs[seed].trial_key for seed in expected]

    def test_forgets_a_divergence(self, store: Store, take: Take, reader: Reader) -> None:
        (claim,) = take(Spec())
        kept = tuple(row for row in assessed().assessments if row.t == 0)
        store.commit(claim, replace(diverged(2), assessments=kept), RUN)
        store.retry("diverged")
        assert reader.rows("SELECT * FROM assessment") == []
        assert reader.rows("SELECT * FROM step") == []
        assert reader.rows("SELECT * FROM trajectory") == []
        (again,) = take(Spec())
        assert store.commit(again, result(), RUN)
        (row,) = reader.trials(Spec().config_key)
        assert (row.status, row.attempt, row.diverged_at) == ("done", 2, None)

    def test_stays_inside_a_grid(self, store: Store, launch: int, take: Take) -> None:
        specs = [Spec(seed) for seed in range(3)]
        for claim in take(*specs):
            store.fail(claim, FAILURE, RUN)
        assert store.retry("failed", [specs[1].trial_key]) == 1
        assert store.register(launch, specs).todo == [specs[1].trial_key]

    def test_refuses_other_statuses(self, store: Store) -> None:
        with pytest.raises(ValueError, match="by the status 'done': give failed"):
            store.retry("done")


Lose = Callable[[Store, list[str]], None]

KILLED = "killed"
MANY = 100
SPECS = [Spec(seed) for seed in range(4)]


@pytest.fixture
def lose_launch(url: str, open_store: Callable[..., Store]) -> Callable[[Store, list[str]], None]:
    """Return a function that lets a launch that holds some trials end without a word."""

    def end_one(store: Store, keys: list[str]) -> None:
        lost = open_store()
        launch = lost.begin_launch(LAUNCH)
        lost.claim(launch, keys)
        lost.close()
        execute(url, f"UPDATE launch SET lease_until = 0 WHERE launch_id = {launch}")
        assert store.recover() == len(keys)

    return end_one


def test_a_configuration_with_its_counts_and_times(store: Store, launch: int, take: Take) -> None:
    store.register(launch, [*SPECS, Spec(0, policy="other")])
    one, two, _ = take(*SPECS[:3])
    store.commit(one, result(), RUN)
    store.commit(two, diverged(2), replace(RUN, wall_seconds=1.5))
    first, second = sorted(store.open_configs(launch), key=lambda config: -config.running)
    assert first.config_key == SPECS[0].config_key
    assert first.config_json == SPECS[0].config_json
    assert (first.pending, first.running) == (1, 1)
    assert (first.mean_seconds, first.max_seconds) == (1.0, 1.5)
    assert (second.pending, second.running, second.mean_seconds) == (1, 0, None)


def test_a_finished_configuration_is_not_open(store: Store, launch: int, take: Take) -> None:
    (claim,) = take(Spec())
    store.commit(claim, result(), RUN)
    assert store.open_configs(launch) == []


def test_pending_trials_of_one_configuration(store: Store, launch: int, take: Take) -> None:
    store.register(launch, [*SPECS, Spec(0, policy="other")])
    take(SPECS[0])
    (config_id,) = {c.config_id for c in store.open_configs(launch) if c.running}
    found = store.open_trials(launch, config_id, MANY, losses=3)
    assert {(one.trial_key, one.seed) for one in found} == {
        (spec.trial_key, spec.seed) for spec in SPECS[1:]
    }
    assert len(store.open_trials(launch, config_id, 2, losses=3)) == 2


def test_a_trial_that_killed_its_process_is_told(store: Store, launch: int, take: Take) -> None:
    take(*SPECS)
    store.release(launch, [SPECS[1].trial_key], KILLED)
    store.release(launch)
    (config,) = store.open_configs(launch)
    crashes = {
        one.seed: one.crashes for one in store.open_trials(launch, config.config_id, MANY, 3)
    }
    assert crashes == {0: 0, 1: 1, 2: 0, 3: 0}


def test_a_trial_whose_launches_were_lost_is_suspect(
    store: Store, launch: int, lose_launch: Lose
) -> None:
    store.register(launch, SPECS)
    lose_launch(store, [SPECS[0].trial_key, SPECS[1].trial_key])
    for _ in range(2):
        lose_launch(store, [SPECS[1].trial_key])
    (config,) = store.open_configs(launch)
    assert {one.seed for one in store.open_trials(launch, config.config_id, MANY, losses=3)} == {
        0,
        2,
        3,
    }
    (suspect,) = store.suspects(launch, losses=3)
    assert (suspect.seed, suspect.lone_losses) == (1, 2)


def test_a_trial_that_is_retried_is_no_suspect(
    store: Store, launch: int, lose_launch: Lose
) -> None:
    keys = store.register(launch, SPECS[:1]).todo
    for _ in range(3):
        lose_launch(store, keys)
    (claim,) = store.claim(launch, keys)
    store.fail(claim, Failure("WorkerLost", "lost", "", "node lost"), RUN)
    store.retry("failed", keys)
    assert store.suspects(launch, losses=3) == []
    (config,) = store.open_configs(launch)
    assert len(store.open_trials(launch, config.config_id, MANY, losses=3)) == 1


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


def test_a_dead_launch_says_running_but_does_not_live(
    open_store: Callable[..., Store], url: str
) -> None:
    dead = open_store()
    dead.begin_launch(LAUNCH)
    dead.close()
    with open_store()._backend.transaction() as connection:
        connection.exec_driver_sql("UPDATE launch SET lease_until = 0")  # long ago, on PostgreSQL
    with Reader.open(url) as reader:
        (launch,) = reader.launches()
    assert (launch.state, launch.alive) == ("running", False)


def test_all_reads_of_a_moment_agree(store: Store, take: Take, reader: Reader) -> None:
    early, late = take(Spec(0), Spec(1))
    store.commit(early, result(0), RUN)
    with reader.moment() as moment:
        assert moment.configs()[0].n_done == 1
        store.commit(late, result(1), RUN)
        assert moment.configs()[0].n_done == 1
        assert len(moment.curves(Spec().config_key).values) == 1
        assert len(moment.rows("SELECT t FROM step")) == HORIZON
    assert reader.configs()[0].n_done == 2


def test_rows_come_in_batches(store: Store, take: Take, reader: Reader) -> None:
    for claim in take(Spec(0), Spec(1)):
        store.commit(claim, result(), RUN)
    sql = "SELECT trial_id, t FROM step WHERE t > :t ORDER BY trial_id, t"
    sizes = [len(rows) for rows in reader.batches(5, sql, t=0)]
    assert sizes == [5, 5, 2]
    assert list(reader.batches(5, sql, t=HORIZON)) == []


def test_batches_can_be_left_early(store: Store, take: Take, reader: Reader) -> None:
    for claim in take(Spec(0)):
        store.commit(claim, result(), RUN)
    with reader.moment() as moment:
        batches = moment.batches(2, "SELECT t FROM step")
        assert len(next(batches)) == 2
        batches.close()
        assert len(moment.rows("SELECT t FROM step")) == HORIZON
