"""Commits and failures: whole or refused, on every database."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from dopt.result import Assessment
from orchestrate.store import (
    Claim,
    Failure,
    InvalidResultError,
    Reader,
    Store,
    StoreUnavailableError,
)
from orchestrate.store.maintenance import examine, upgrade
from orchestrate.store.records import DTYPE, finite_list, pack, unpack, utc_text
from orchestrate.store.schema import STEP_VALUES
from tests.orchestrate.store.databases import execute
from tests.orchestrate.store.fakes import (
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

Take = Callable[..., list[Claim]]


class TestCommit:
    def test_gives_back_every_number(self, store: Store, take: Take, reader: Reader) -> None:
        (claim,) = take(Spec())
        sent = result()
        assert store.commit(claim, sent, RUN)
        for name in ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us"):
            curves = reader.curves(Spec().config_key, name)
            np.testing.assert_array_equal(curves.values, [getattr(sent, name)], strict=True)
        arrays = reader.trajectory(Spec().config_key, 0)
        for name in ("states", "inputs", "parameters"):
            np.testing.assert_array_equal(getattr(arrays, name), getattr(sent, name), strict=True)

    def test_gives_the_final_losses_of_trials_that_are_done(self, store: Store, take: Take) -> None:
        specs = [Spec(seed) for seed in range(4)]
        whole, lost, failed, _ = take(*specs)
        store.commit(whole, result(), RUN)
        store.commit(lost, diverged(at=3), RUN)
        store.fail(failed, Failure("ZeroDivisionError", "no", "here"), RUN)
        keys = [spec.trial_key for spec in specs]
        assert store.final_losses(keys) == {whole.trial_key: result().loss[-1]}
        assert store.final_losses(keys[1:]) == store.final_losses([]) == {}

    def test_gives_back_the_assessments(self, store: Store, take: Take, reader: Reader) -> None:
        for claim, seed in zip(take(Spec(0), Spec(1)), (0, 1), strict=True):
            assert store.commit(claim, assessed(seed), RUN)
        rows = [row for seed in (0, 1) for row in assessed(seed).assessments]
        found = reader.assessments(Spec().config_key, "cost")
        assert (found.seeds.tolist(), found.t.tolist()) == ([0, 1], [0, 3, 7])
        costs = [row.value for row in rows if row.measure == "cost"]
        assert found.values.ravel().tolist() == costs
        errors = reader.assessments(Spec().config_key, "error").values
        assert np.isnan(errors[:, 2]).all()
        assert np.isfinite(errors[:, :2]).all()
        assert reader.rows("SELECT count(*) FROM assessment WHERE value IS NULL") == [(2,)]
        assert reader.measures(Spec().config_key) == ["cost", "error"]
        assert reader.assessments(Spec().config_key, "nothing").values.shape == (0, 0)

    @pytest.mark.parametrize(
        ("row", "words"),
        [
            (Assessment(8, "cost", 1.0), "'cost' is of step 8, expected one from 0 to 7"),
            (Assessment(3, "cost", 1.0), "'cost' of step 3 is given twice"),
        ],
    )
    def test_refuses_assessments_that_do_not_fit(
        self, store: Store, take: Take, reader: Reader, row: Assessment, words: str
    ) -> None:
        (claim,) = take(Spec())
        sent = replace(assessed(), assessments=(*assessed().assessments, row))
        with pytest.raises(InvalidResultError, match=words):
            store.commit(claim, sent, RUN)
        assert reader.rows("SELECT * FROM assessment") == []

    @pytest.mark.parametrize("horizon", [1, 99, 100, 101, 250])
    def test_numbers_the_steps(
        self, store: Store, take: Take, reader: Reader, horizon: int
    ) -> None:
        (claim,) = take(Spec(horizon=horizon))
        sent = result(horizon=horizon)
        store.commit(claim, sent, RUN)
        rows = reader.rows("SELECT t, evaluate_us FROM step ORDER BY t")
        assert [row.t for row in rows] == list(range(horizon))
        assert [row.evaluate_us for row in rows] == sent.evaluate_us.tolist()

    def test_knows_the_horizon_of_each_configuration(self, store: Store, take: Take) -> None:
        long, short = take(Spec(horizon=20), Spec(horizon=10))
        with pytest.raises(InvalidResultError, match="20 steps, expected the horizon 10"):
            store.commit(short, result(horizon=20), RUN)
        assert store.commit(short, result(horizon=10), RUN)
        assert store.commit(long, result(horizon=20), RUN)

    def test_writes_the_summary(
        self, store: Store, launch: int, take: Take, reader: Reader
    ) -> None:
        (claim,) = take(Spec())
        sent, later = result(), datetime(2126, 1, 31, 12, 0, 0, 250, tzinfo=UTC)
        store.commit(claim, sent, replace(RUN, started=later, ended=later))
        (row,) = reader.trials(Spec().config_key)
        assert (row.status, row.n_steps, row.diverged_at) == ("done", HORIZON, None)
        assert (row.final_loss, row.best_loss) == (sent.final_loss, sent.best_loss)
        assert (row.wall_seconds, row.cpu_seconds) == (RUN.wall_seconds, RUN.cpu_seconds)
        assert (row.peak_memory_bytes, row.node, row.launch) == (2**33, "here", launch)
        assert reader.rows("SELECT owner FROM trial")[0].owner is None
        (attempt,) = reader.rows("SELECT outcome, pid, started, launch_id FROM attempt")
        assert tuple(attempt) == ("done", 18, "2126-01-31T12:00:00.000250Z", launch)

    @pytest.mark.parametrize("fate", ["done", "failed", "released", "lost", "saved"])
    def test_no_end_stands_before_a_beginning(
        self, store: Store, launch: int, take: Take, reader: Reader, url: str, fate: str
    ) -> None:
        """The clocks of two machines differ, or one was set back, by hours."""
        (claim,) = take(Spec())
        ahead = "2126-01-31T12:00:00.000000Z"
        execute(url, f"UPDATE attempt SET claimed = '{ahead}'")
        execute(url, f"UPDATE launch SET started = '{ahead}'")
        if fate == "done":
            assert store.commit(claim, result(), RUN)
        elif fate == "failed":
            backwards = replace(RUN, ended=RUN.started - timedelta(hours=1))
            assert store.fail(claim, Failure("E", "m", "t"), backwards)
        elif fate == "released":
            assert store.release(launch) == 1
        elif fate == "saved":
            store.release(launch)
            assert store.save(launch, Spec(), result(), RUN)
        store.end_launch(launch, "lost" if fate == "lost" else "done")
        for row in reader.rows("SELECT claimed, started, ended FROM attempt"):
            assert row.claimed <= (row.started or row.claimed) <= row.ended
        (row,) = reader.rows("SELECT started, ended FROM launch")
        assert row.started <= row.ended

    def test_keeps_a_divergence_as_null(self, store: Store, take: Take, reader: Reader) -> None:
        kinds = [(at, value) for at in (0, 3) for value in (np.nan, np.inf, -np.inf)]
        for claim, (at, value) in zip(take(*map(Spec, range(6))), kinds, strict=True):
            assert store.commit(claim, diverged(at, value=value), RUN)
        rows = reader.rows(
            "SELECT count(*), count(loss), count(plan_us) FROM step GROUP BY trial_id ORDER BY 1, 2"
        )
        assert [tuple(row) for row in rows] == [(HORIZON, at, at) for at in (0, 0, 0, 3, 3, 3)]
        trials = reader.trials(Spec().config_key)
        assert {trial.status for trial in trials} == {"diverged"}
        assert [(one.diverged_at, one.n_steps) for one in trials] == [(at, at) for at, _ in kinds]
        assert {trial.final_loss for trial in trials} == {None}

    def test_takes_numpy_scalars(self, store: Store, take: Take, reader: Reader) -> None:
        (claim,) = take(Spec())
        sent = replace(diverged(3), diverged_at=np.int64(3), n_steps=np.int32(3))  # type: ignore[arg-type]
        run = replace(RUN, pid=np.int64(1), peak_memory_bytes=np.int64(5))  # type: ignore[arg-type]
        assert store.commit(claim, sent, run)
        (row,) = reader.rows("SELECT seed FROM trial WHERE diverged_at = 3 AND n_steps = 3")
        assert row.seed == 0

    def test_of_many_is_one_for_each(self, store: Store, take: Take, reader: Reader) -> None:
        claims = take(*(Spec(seed) for seed in range(3)))
        items = [(claim, result(claim.trial_id), RUN) for claim in reversed(claims)]
        late = (replace(claims[0], attempt=9), result(), RUN)
        assert store.commit_many([items[0], late, *items[1:]]) == [True, False, True, True]
        expected = [result(claim.trial_id).loss for claim in claims]
        np.testing.assert_array_equal(reader.curves(Spec().config_key).values, expected)


class TestFence:
    def test_refuses_a_doubled_commit(self, store: Store, take: Take, reader: Reader) -> None:
        (claim,) = take(Spec())
        assert store.commit(claim, result(1), RUN)
        assert not store.commit(claim, result(2), RUN)
        assert not store.fail(claim, Failure("E", "m", "t"), RUN)
        np.testing.assert_array_equal(reader.curves(Spec().config_key).values[0], result(1).loss)

    @pytest.mark.parametrize("again", ["same launch", "other launch"])
    def test_refuses_a_late_commit(
        self, store: Store, launch: int, take: Take, reader: Reader, again: str
    ) -> None:
        (late,) = take(Spec())
        store.release(launch)
        owner = launch if again == "same launch" else store.begin_launch(LAUNCH)
        (claim,) = store.claim(owner, [late.trial_key])
        assert not store.commit(late, assessed(1), RUN)
        assert reader.rows("SELECT * FROM step") == []
        assert reader.rows("SELECT * FROM assessment") == []
        assert store.commit(claim, result(2), RUN)
        np.testing.assert_array_equal(reader.curves(Spec().config_key).values[0], result(2).loss)

    def test_refuses_a_late_failure(
        self, store: Store, launch: int, take: Take, reader: Reader
    ) -> None:
        (late,) = take(Spec())
        store.release(launch)
        assert not store.fail(late, Failure("E", "m", "t"), RUN)
        assert reader.rows("SELECT * FROM error") == []
        assert reader.trials(Spec().config_key)[0].status == "pending"

    def test_refuses_a_claim_of_somebody_else(self, store: Store, take: Take) -> None:
        (claim,) = take(Spec())
        forged = replace(claim, launch=store.begin_launch(LAUNCH))
        assert not store.commit(forged, result(), RUN)


def _with_hole() -> FakeResult:
    hole = result()
    hole.loss[2] = np.nan
    return hole


MALFORMED = {
    "'learn_us' has shape": replace(result(), learn_us=np.zeros(HORIZON - 1)),
    "'states' has shape": replace(result(), states=np.zeros((HORIZON, 4))),
    "'inputs' has shape": replace(result(), inputs=np.zeros(HORIZON)),
    "'parameters' has shape": replace(result(), parameters=np.zeros((2, 2))),
    "loss of step 2 is not finite": _with_hole(),
    "'diverged_at' is 7": replace(result(), diverged_at=HORIZON),
    "losses after the divergence": replace(result(), diverged_at=3),
    f"8 steps, expected the horizon {HORIZON}": result(horizon=8),
}


class TestMalformedResult:
    def test_is_refused_whole(self, store: Store, take: Take, reader: Reader) -> None:
        good, bad = take(Spec(0), Spec(1))
        for reason, malformed in MALFORMED.items():
            with pytest.raises(InvalidResultError, match=reason):
                store.commit_many([(good, result(), RUN), (bad, malformed, RUN)])
            assert reader.rows("SELECT * FROM step") == []
        assert store.commit(bad, result(), RUN)

    def test_needs_times_with_a_zone(self, store: Store, take: Take) -> None:
        (claim,) = take(Spec())
        local = replace(RUN, started=datetime(2026, 1, 1))
        with pytest.raises(ValueError, match="no time zone"):
            store.commit(claim, result(), local)


class TestFailure:
    def test_is_written_down_once_for_each_cause(
        self, store: Store, take: Take, reader: Reader
    ) -> None:
        for claim in take(*(Spec(seed) for seed in range(3))):
            assert store.fail(claim, Failure("ValueError", "no", "Traceback", "timeout"), RUN)
        assert len(reader.rows("SELECT * FROM error")) == 1
        rows = reader.rows("SELECT seed, cause, type, message, traceback FROM v_failures")
        assert sorted(tuple(row) for row in rows) == [
            (seed, "timeout", "ValueError", "no", "Traceback") for seed in range(3)
        ]
        (first, *_) = reader.trials(Spec().config_key)
        assert (first.status, first.error_type, first.node) == ("failed", "ValueError", "here")

    def test_stays_in_the_history_of_a_trial(
        self, store: Store, take: Take, reader: Reader
    ) -> None:
        (claim,) = take(Spec())
        store.fail(claim, Failure("E", "m", "t"), RUN)
        store.retry("failed")
        (again,) = take(Spec())
        store.commit(again, result(), RUN)
        rows = reader.rows("SELECT attempt, outcome FROM attempt ORDER BY attempt")
        assert [tuple(row) for row in rows] == [(1, "failed"), (2, "done")]
        assert reader.rows("SELECT status FROM v_failures")[0].status == "done"
        assert reader.trials(Spec().config_key)[0].error_type is None

    def test_may_say_what_no_database_takes(self, store: Store, take: Take, reader: Reader) -> None:
        (claim,) = take(Spec())
        text = "a zero \0 and the name of a file, \udcff"
        assert store.fail(claim, Failure("OSError", text, f"Traceback\n{text}"), RUN)
        (row,) = reader.rows("SELECT message, traceback FROM v_failures")
        assert row.message == r"a zero \x00 and the name of a file, \udcff"
        assert row.traceback == f"Traceback\n{row.message}"


SEEDS = range(4)


@pytest.fixture
def finished(store: Store, take: Take) -> list[Spec]:
    """Return done trials of one configuration, and a diverged one."""
    specs = [Spec(seed) for seed in SEEDS]
    for spec, claim in zip(specs, take(*specs), strict=True):
        store.commit(claim, diverged(3) if spec.seed == 2 else result(spec.seed), RUN)
    return specs


def matrices(reader: Reader) -> list[np.ndarray]:
    return [reader.curves(Spec().config_key, name).values for name in STEP_VALUES]


def stored_once(reader: Reader) -> list[np.ndarray]:
    rows = reader.rows(
        f"SELECT {', '.join(STEP_VALUES)} FROM step JOIN trial USING (trial_id) ORDER BY seed, t"
    )
    numbers = np.array([tuple(row) for row in rows], dtype=np.float64)
    return [column.reshape(len(SEEDS), -1) for column in numbers.T]


def test_they_are_the_numbers_of_the_steps(finished: list[Spec], reader: Reader) -> None:
    assert len(reader.rows("SELECT * FROM curve")) == len(finished)
    for packed, steps in zip(matrices(reader), stored_once(reader), strict=True):
        np.testing.assert_array_equal(packed, steps)


def test_no_step_is_read_where_they_are(finished: list[Spec], reader: Reader, url: str) -> None:
    before = matrices(reader)
    execute(url, "DELETE FROM step")
    np.testing.assert_array_equal(matrices(reader), before)
    assert len(before[0]) == len(finished)


@pytest.mark.parametrize(
    "change",
    [
        "DELETE FROM curve",
        "DELETE FROM curve WHERE trial_id = 2",
        "UPDATE curve SET attempt = 7, loss = reachable_loss WHERE trial_id IN (1, 4)",
    ],
)
def test_steps_are_read_where_they_are_not(
    finished: list[Spec], reader: Reader, url: str, change: str
) -> None:
    before = matrices(reader)
    execute(url, change)
    np.testing.assert_array_equal(matrices(reader), before)
    done = upgrade(url)
    assert 0 < done.packed <= len(finished)
    assert upgrade(url).packed == 0
    execute(url, "DELETE FROM step")
    np.testing.assert_array_equal(matrices(reader), before)


@pytest.mark.usefixtures("finished")
def test_a_damaged_array_is_found_and_not_read(reader: Reader, url: str) -> None:
    execute(url, "UPDATE curve SET loss = (SELECT states FROM trajectory WHERE trial_id = 1)")
    with pytest.raises(StoreUnavailableError, match=r"incomplete \(0 steps instead of 28"):
        reader.curves(Spec().config_key)
    (found,) = [one for one in examine(url) if one.severity == "error"]
    assert (found.count, "upgrade" in found.advice) == (len(SEEDS), True)
    execute(url, "DELETE FROM curve")
    upgrade(url)
    assert [one for one in examine(url) if one.severity == "error"] == []


@pytest.mark.usefixtures("finished")
def test_a_trial_that_runs_again_has_its_new_one(store: Store, reader: Reader, take: Take) -> None:
    assert store.retry("diverged") == 1
    assert len(reader.rows("SELECT * FROM curve")) == len(SEEDS) - 1
    (claim,) = take(Spec(2))
    store.commit(claim, result(2), RUN)
    found = reader.curves(Spec().config_key)
    np.testing.assert_array_equal(found.values[2], result(2).loss)
    assert not found.diverged.any()


class Explored(Spec):
    @property
    def config_json(self) -> str:
        return '{"env":{"loss":"prequential"}}'


def test_that_of_an_exploration_grows_with_it(url: str) -> None:
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


def test_a_measure_is_added_to_trials_that_are_done_in_place_of_its_value(
    store: Store, take: Take, reader: Reader
) -> None:
    done, lost, _ = take(*(Spec(seed) for seed in range(3)))
    store.commit(done, assessed(), RUN)
    store.commit(lost, diverged(3), RUN)
    keys = [Spec(seed).trial_key for seed in range(3)]
    before = reader.assessments(Spec().config_key, "cost").values
    for value in (1.5, 0.25):
        assert store.add_assessments({key: Assessment(7, "added", value) for key in keys}) == 1
        found = reader.assessments(Spec().config_key, "added")
        assert (found.seeds.tolist(), found.t.tolist()) == ([0], [7])
        assert found.values == value
    np.testing.assert_array_equal(reader.assessments(Spec().config_key, "cost").values, before)


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
