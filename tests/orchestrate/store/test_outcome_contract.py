"""Commits and failures: whole or refused, on every database."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from dopt.result import Assessment
from orchestrate.store import Failure, InvalidResultError, Reader, Store, StoreUnavailableError
from orchestrate.store.maintenance import examine, upgrade
from orchestrate.store.records import DTYPE, finite_list, pack, unpack, utc_text
from orchestrate.store.schema import STEP_VALUES
from tests.orchestrate.store.conftest import Database
from tests.orchestrate.store.databases import execute
from tests.orchestrate.store.fakes import (
    FAILURE,
    HORIZON,
    LAUNCH,
    RUN,
    Array,
    FakeResult,
    Spec,
    assessed,
    diverged,
    result,
)

KEY = Spec().config_key


# Commits


def test_a_commit_gives_back_every_number_and_its_summary(db: Database) -> None:
    (claim,) = db.take(Spec())
    sent, later = result(), datetime(2126, 1, 31, 12, 0, 0, 250, tzinfo=UTC)
    assert db.store.commit(claim, sent, replace(RUN, started=later, ended=later))
    for name in STEP_VALUES:
        np.testing.assert_array_equal(db.curves(name).values, [getattr(sent, name)], strict=True)
    arrays = db.reader.trajectory(KEY, 0)
    for name in ("states", "inputs", "parameters"):
        np.testing.assert_array_equal(getattr(arrays, name), getattr(sent, name), strict=True)
    (row,) = db.reader.trials(KEY)
    assert (row.status, row.n_steps, row.diverged_at) == ("done", HORIZON, None)
    assert (row.final_loss, row.best_loss) == (sent.final_loss, sent.best_loss)
    assert (row.wall_seconds, row.cpu_seconds) == (RUN.wall_seconds, RUN.cpu_seconds)
    assert (row.peak_memory_bytes, row.node, row.launch_id) == (2**33, "here", db.launch)
    assert db.rows("SELECT owner FROM trial") == [(None,)]
    assert db.rows("SELECT outcome, pid, started, launch_id FROM attempt") == [
        ("done", 18, "2126-01-31T12:00:00.000250Z", db.launch)
    ]


def test_final_losses_are_of_trials_that_are_done(db: Database) -> None:
    specs = [Spec(seed) for seed in range(4)]
    whole, lost, failed, _ = db.take(*specs)
    db.store.commit(whole, result(), RUN)
    db.store.commit(lost, diverged(at=3), RUN)
    db.store.fail(failed, FAILURE, RUN)
    keys = [spec.trial_key for spec in specs]
    assert db.store.final_losses(keys) == {whole.trial_key: result().loss[-1]}
    assert db.store.final_losses(keys[1:]) == db.store.final_losses([]) == {}


def test_assessments_come_back_and_others_are_refused(db: Database) -> None:
    one, two = db.take(Spec(0), Spec(1))
    for row, words in (
        (Assessment(8, "cost", 1.0), "'cost' is of step 8, expected one from 0 to 7"),
        (Assessment(3, "cost", 1.0), "'cost' of step 3 is given twice"),
    ):
        sent = replace(assessed(), assessments=(*assessed().assessments, row))
        with pytest.raises(InvalidResultError, match=words):
            db.store.commit(one, sent, RUN)
        assert db.rows("SELECT * FROM assessment") == []
    for claim, seed in ((one, 0), (two, 1)):
        assert db.store.commit(claim, assessed(seed), RUN)
    rows = [row for seed in (0, 1) for row in assessed(seed).assessments]
    found = db.reader.assessments(KEY, "cost")
    assert (found.seeds.tolist(), found.t.tolist()) == ([0, 1], [0, 3, 7])
    assert found.values.ravel().tolist() == [row.value for row in rows if row.measure == "cost"]
    errors = db.reader.assessments(KEY, "error").values
    assert np.isnan(errors).tolist() == [[False, False, True]] * 2
    assert db.rows("SELECT count(*) FROM assessment WHERE value IS NULL") == [(2,)]
    assert db.reader.measures(KEY) == ["cost", "error"]
    assert db.reader.assessments(KEY, "nothing").values.shape == (0, 0)


def test_a_commit_numbers_the_steps_up_to_the_horizon_of_its_configuration(db: Database) -> None:
    horizons = (1, 99, 100, 101, 250)
    claims = db.take(*(Spec(horizon=horizon) for horizon in horizons))
    with pytest.raises(InvalidResultError, match="99 steps, expected the horizon 100"):
        db.store.commit(claims[2], result(horizon=99), RUN)
    for claim, horizon in zip(claims, horizons, strict=True):
        sent = result(horizon=horizon)
        assert db.store.commit(claim, sent, RUN)
        steps = f"SELECT t, evaluate_us FROM step WHERE trial_id = {claim.trial_id} ORDER BY t"
        assert db.rows(steps) == list(enumerate(sent.evaluate_us.tolist()))


@pytest.mark.parametrize("fate", ["done", "failed", "released", "lost", "saved"])
def test_no_end_stands_before_a_beginning(db: Database, fate: str) -> None:
    """The clocks of two machines differ, or one was set back, by hours."""
    (claim,) = db.take(Spec())
    ahead = "2126-01-31T12:00:00.000000Z"
    execute(db.url, f"UPDATE attempt SET claimed = '{ahead}'")
    execute(db.url, f"UPDATE launch SET started = '{ahead}'")
    if fate == "done":
        assert db.store.commit(claim, result(), RUN)
    elif fate == "failed":
        backwards = replace(RUN, ended=RUN.started - timedelta(hours=1))
        assert db.store.fail(claim, FAILURE, backwards)
    elif fate in ("released", "saved"):
        assert db.store.release(db.launch) == 1
    if fate == "saved":
        assert db.store.save(db.launch, Spec(), result(), RUN)
    db.store.end_launch(db.launch, "lost" if fate == "lost" else "done")
    for claimed, started, ended in db.rows("SELECT claimed, started, ended FROM attempt"):
        assert claimed <= (started or claimed) <= ended
    [(started, ended)] = db.rows("SELECT started, ended FROM launch")
    assert started <= ended


def test_a_divergence_is_kept_as_null(db: Database) -> None:
    kinds = [(at, value) for at in (0, 3) for value in (np.nan, np.inf, -np.inf)]
    for claim, (at, value) in zip(db.take(*map(Spec, range(6))), kinds, strict=True):
        assert db.store.commit(claim, diverged(at, value=value), RUN)
    counts = "SELECT count(*), count(loss), count(plan_us) FROM step GROUP BY trial_id"
    assert sorted(db.rows(counts)) == [(HORIZON, at, at) for at, _ in kinds]
    trials = db.reader.trials(KEY)
    assert {(trial.status, trial.final_loss) for trial in trials} == {("diverged", None)}
    assert [(one.diverged_at, one.n_steps) for one in trials] == [(at, at) for at, _ in kinds]


def test_a_commit_takes_numpy_scalars(db: Database) -> None:
    (claim,) = db.take(Spec())
    sent = replace(diverged(3), diverged_at=np.int64(3), n_steps=np.int32(3))  # type: ignore[arg-type]
    run = replace(RUN, pid=np.int64(1), peak_memory_bytes=np.int64(5))  # type: ignore[arg-type]
    assert db.store.commit(claim, sent, run)
    assert db.rows("SELECT seed FROM trial WHERE diverged_at = 3 AND n_steps = 3") == [(0,)]


def test_a_commit_of_many_is_one_for_each(db: Database) -> None:
    claims = db.take(*(Spec(seed) for seed in range(3)))
    items = [(claim, result(claim.trial_id), RUN) for claim in reversed(claims)]
    late = (replace(claims[0], attempt=9), result(), RUN)
    assert db.store.commit_many([items[0], late, *items[1:]]) == [True, False, True, True]
    expected = [result(claim.trial_id).loss for claim in claims]
    np.testing.assert_array_equal(db.curves().values, expected)


# The fence


def test_a_doubled_commit_and_a_claim_of_somebody_else_are_refused(db: Database) -> None:
    (claim,) = db.take(Spec())
    forged = replace(claim, launch=db.store.begin_launch(LAUNCH))
    assert not db.store.commit(forged, result(), RUN)
    assert db.store.commit(claim, result(1), RUN)
    assert not db.store.commit(claim, result(2), RUN)
    assert not db.store.fail(claim, FAILURE, RUN)
    np.testing.assert_array_equal(db.curves().values[0], result(1).loss)


@pytest.mark.parametrize("again", ["same launch", "other launch"])
def test_a_late_outcome_is_refused(db: Database, again: str) -> None:
    (late,) = db.take(Spec())
    db.store.release(db.launch)
    assert not db.store.fail(late, FAILURE, RUN)
    assert db.reader.trials(KEY)[0].status == "pending"
    owner = db.launch if again == "same launch" else db.store.begin_launch(LAUNCH)
    (claim,) = db.store.claim(owner, [late.trial_key])
    assert not db.store.commit(late, assessed(1), RUN)
    for table in ("step", "assessment", "error"):
        assert db.rows(f"SELECT * FROM {table}") == []
    assert db.store.commit(claim, result(2), RUN)
    np.testing.assert_array_equal(db.curves().values[0], result(2).loss)


HOLE = np.where(np.arange(HORIZON) == 2, np.nan, result().loss)
MALFORMED = {
    "'learn_us' has shape": replace(result(), learn_us=np.zeros(HORIZON - 1)),
    "'states' has shape": replace(result(), states=np.zeros((HORIZON, 4))),
    "'inputs' has shape": replace(result(), inputs=np.zeros(HORIZON)),
    "'parameters' has shape": replace(result(), parameters=np.zeros((2, 2))),
    "loss of step 2 is not finite": replace(result(), loss=HOLE),
    "'diverged_at' is 7": replace(result(), diverged_at=HORIZON),
    "losses after the divergence": replace(result(), diverged_at=3),
    f"8 steps, expected the horizon {HORIZON}": result(horizon=8),
}


def test_a_malformed_result_is_refused_whole(db: Database) -> None:
    good, bad = db.take(Spec(0), Spec(1))
    for reason, malformed in MALFORMED.items():
        with pytest.raises(InvalidResultError, match=reason):
            db.store.commit_many([(good, result(), RUN), (bad, malformed, RUN)])
        assert db.rows("SELECT * FROM step") == []
    with pytest.raises(ValueError, match="no time zone"):
        db.store.commit(bad, result(), replace(RUN, started=datetime(2026, 1, 1)))
    assert db.store.commit(bad, result(), RUN)


# Failures


def test_a_failure_is_written_down_once_for_each_cause(db: Database) -> None:
    for claim in db.take(*(Spec(seed) for seed in range(3))):
        assert db.store.fail(claim, Failure("ValueError", "no", "Traceback", "timeout"), RUN)
    assert len(db.rows("SELECT * FROM error")) == 1
    assert sorted(db.rows("SELECT seed, cause, type, message, traceback FROM v_failures")) == [
        (seed, "timeout", "ValueError", "no", "Traceback") for seed in range(3)
    ]
    (first, *_) = db.reader.trials(KEY)
    assert (first.status, first.error_type, first.node) == ("failed", "ValueError", "here")


def test_a_failure_stays_in_the_history_of_a_trial(db: Database) -> None:
    (claim,) = db.take(Spec())
    text = "a zero \0 and the name of a file, \udcff"
    assert db.store.fail(claim, Failure("OSError", text, f"Traceback\n{text}"), RUN)
    shown = r"a zero \x00 and the name of a file, \udcff"
    failures = "SELECT message, traceback, status FROM v_failures"
    assert db.rows(failures) == [(shown, f"Traceback\n{shown}", "failed")]
    db.store.retry("failed")
    db.store.commit(*db.take(Spec()), result(), RUN)
    rows = db.rows("SELECT attempt, outcome FROM attempt ORDER BY attempt")
    assert rows == [(1, "failed"), (2, "done")]
    assert db.rows(failures)[0][2] == "done"
    assert db.reader.trials(KEY)[0].error_type is None


# Curves as arrays beside the steps

SEEDS = range(4)


@pytest.fixture
def finished(db: Database) -> Database:
    """Return a database with done trials of one configuration, and a diverged one."""
    for seed, claim in zip(SEEDS, db.take(*map(Spec, SEEDS)), strict=True):
        db.store.commit(claim, diverged(3) if seed == 2 else result(seed), RUN)
    return db


def matrices(db: Database) -> list[Array]:
    return [db.curves(name).values for name in STEP_VALUES]


def test_arrays_are_the_numbers_of_the_steps_and_are_read_in_their_place(
    finished: Database,
) -> None:
    assert finished.rows("SELECT count(*) FROM curve") == [(len(SEEDS),)]
    names = ", ".join(STEP_VALUES)
    rows = finished.rows(f"SELECT {names} FROM step JOIN trial USING (trial_id) ORDER BY seed, t")
    steps = np.array(rows, dtype=np.float64).T.reshape(len(STEP_VALUES), len(SEEDS), -1)
    np.testing.assert_array_equal(matrices(finished), steps)
    execute(finished.url, "DELETE FROM step")
    np.testing.assert_array_equal(matrices(finished), steps)


@pytest.mark.parametrize(
    "change",
    [
        "DELETE FROM curve",
        "DELETE FROM curve WHERE trial_id = 2",
        "UPDATE curve SET attempt = 7, loss = reachable_loss WHERE trial_id IN (1, 4)",
    ],
)
def test_steps_are_read_where_no_array_is(finished: Database, change: str) -> None:
    before = matrices(finished)
    execute(finished.url, change)
    np.testing.assert_array_equal(matrices(finished), before)
    done = upgrade(finished.url)
    assert 0 < done.packed <= len(SEEDS)
    assert upgrade(finished.url).packed == 0
    execute(finished.url, "DELETE FROM step")
    np.testing.assert_array_equal(matrices(finished), before)


def errors(url: str) -> list[tuple[int, bool]]:
    found = [one for one in examine(url) if one.severity == "error"]
    return [(one.count, "upgrade" in one.advice) for one in found]


def test_a_damaged_array_is_found_and_not_read(finished: Database) -> None:
    damage = "UPDATE curve SET loss = (SELECT states FROM trajectory WHERE trial_id = 1)"
    execute(finished.url, damage)
    with pytest.raises(StoreUnavailableError, match=r"incomplete \(0 steps instead of 28"):
        finished.curves()
    assert errors(finished.url) == [(len(SEEDS), True)]
    execute(finished.url, "DELETE FROM curve")
    upgrade(finished.url)
    assert errors(finished.url) == []


def test_a_trial_that_runs_again_has_its_new_array(finished: Database) -> None:
    assert finished.store.retry("diverged") == 1
    assert finished.rows("SELECT count(*) FROM curve") == [(len(SEEDS) - 1,)]
    finished.store.commit(*finished.take(Spec(2)), result(2), RUN)
    found = finished.curves()
    np.testing.assert_array_equal(found.values[2], result(2).loss)
    assert not found.diverged.any()


class Explored(Spec):
    @property
    def config_json(self) -> str:
        return '{"env":{"loss":"prequential"}}'


def test_the_array_of_an_exploration_grows_with_it(url: str) -> None:
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        last = store.save(launch, Explored(), first_steps(3), RUN)
        store.save(launch, Explored(), first_steps(5), RUN, last)
        store.end_launch(launch, "done")
    execute(url, "DELETE FROM step")
    with Reader.open(url) as reader:
        found = reader.curves(Explored().config_key).values
    np.testing.assert_array_equal(found, [result().loss[:5]])


def first_steps(n: int) -> FakeResult:
    """Return a result that has come to its first n steps."""
    whole = result()
    cut = {name: getattr(whole, name)[:n] for name in (*STEP_VALUES, "inputs")}
    final = float(whole.loss[n - 1])
    return replace(whole, **cut, states=whole.states[: n + 1], n_steps=n, final_loss=final)


def test_a_measure_is_added_to_trials_that_are_done_in_place_of_its_value(db: Database) -> None:
    done, lost, _ = db.take(*(Spec(seed) for seed in range(3)))
    db.store.commit(done, assessed(), RUN)
    db.store.commit(lost, diverged(3), RUN)
    keys = [Spec(seed).trial_key for seed in range(3)]
    before = db.reader.assessments(KEY, "cost").values
    for value in (1.5, 0.25):
        assert db.store.add_assessments({key: Assessment(7, "added", value) for key in keys}) == 1
        found = db.reader.assessments(KEY, "added")
        assert (found.seeds.tolist(), found.t.tolist()) == ([0], [7])
        assert found.values == value
    np.testing.assert_array_equal(db.reader.assessments(KEY, "cost").values, before)


# Forms of values in a database


@given(arrays.arrays(np.float64, arrays.array_shapes(min_dims=1, max_dims=2, min_side=0)))
def test_packed_arrays_come_back_bit_for_bit(array: Array) -> None:
    shape, data = pack(array)
    back = unpack(DTYPE, shape, data)
    assert back.shape == array.shape
    assert back.tobytes() == array.tobytes()


def test_arrays_of_any_layout_are_packed_rows_first() -> None:
    array = np.asfortranarray(np.arange(6.0).reshape(2, 3)).astype(">f8")
    shape, data = pack(array)
    assert json.loads(shape) == [2, 3]
    assert data == np.arange(6, dtype="<f8").tobytes()


@given(st.lists(st.floats()))
def test_numbers_that_are_not_finite_become_none(numbers: list[float]) -> None:
    expected = [x if np.isfinite(x) else None for x in numbers]
    assert finite_list(np.array(numbers, dtype=np.float64)) == expected


def test_times_are_utc_text_that_sorts() -> None:
    east = timezone(timedelta(hours=5, minutes=30))
    assert utc_text(datetime(2026, 1, 1, 5, 30, tzinfo=east)) == "2026-01-01T00:00:00.000000Z"
