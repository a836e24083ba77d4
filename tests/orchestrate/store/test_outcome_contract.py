"""Commits and failures: whole or refused, on every database."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from dopt.result import Assessment
from orchestrate.store import Claim, Failure, InvalidResultError, Reader, Store
from tests.orchestrate.store.fakes import (
    HORIZON,
    LAUNCH,
    RUN,
    FakeResult,
    Spec,
    assessed,
    diverged,
    result,
)
from tests.orchestrate.store.places import execute

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
        assert reader.query("SELECT count(*) FROM assessment WHERE value IS NULL") == [(2,)]
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
        assert reader.query("SELECT * FROM assessment") == []

    def test_writes_no_assessment_without_its_claim(
        self, store: Store, launch: int, take: Take, reader: Reader
    ) -> None:
        (claim,) = take(Spec())
        store.release(launch)
        assert not store.commit(claim, assessed(), RUN)
        assert reader.query("SELECT * FROM assessment") == []

    @pytest.mark.parametrize("horizon", [1, 99, 100, 101, 250])
    def test_numbers_the_steps(
        self, store: Store, take: Take, reader: Reader, horizon: int
    ) -> None:
        (claim,) = take(Spec(horizon=horizon))
        sent = result(horizon=horizon)
        store.commit(claim, sent, RUN)
        rows = reader.query("SELECT t, evaluate_us FROM step ORDER BY t")
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
        assert reader.query("SELECT owner FROM trial")[0].owner is None
        (attempt,) = reader.query("SELECT outcome, pid, started, launch_id FROM attempt")
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
        for row in reader.query("SELECT claimed, started, ended FROM attempt"):
            assert row.claimed <= (row.started or row.claimed) <= row.ended
        (row,) = reader.query("SELECT started, ended FROM launch")
        assert row.started <= row.ended

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("at", [0, 3])
    def test_keeps_a_divergence_as_null(
        self, store: Store, take: Take, reader: Reader, at: int, value: float
    ) -> None:
        (claim,) = take(Spec())
        assert store.commit(claim, diverged(at, value=value), RUN)
        (row,) = reader.query(
            "SELECT count(*) AS n, count(loss) AS loss, count(plan_us) AS plan FROM step"
        )
        assert tuple(row) == (HORIZON, at, at)
        (trial,) = reader.trials(Spec().config_key)
        assert (trial.status, trial.diverged_at, trial.n_steps) == ("diverged", at, at)
        assert trial.final_loss is None

    def test_takes_numpy_scalars(self, store: Store, take: Take, reader: Reader) -> None:
        (claim,) = take(Spec())
        sent = replace(diverged(3), diverged_at=np.int64(3), n_steps=np.int32(3))  # type: ignore[arg-type]
        run = replace(RUN, pid=np.int64(1), peak_memory_bytes=np.int64(5))  # type: ignore[arg-type]
        assert store.commit(claim, sent, run)
        (row,) = reader.query("SELECT seed FROM trial WHERE diverged_at = 3 AND n_steps = 3")
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
        assert not store.commit(late, result(1), RUN)
        assert reader.query("SELECT * FROM step") == []
        assert store.commit(claim, result(2), RUN)
        np.testing.assert_array_equal(reader.curves(Spec().config_key).values[0], result(2).loss)

    def test_refuses_a_late_failure(
        self, store: Store, launch: int, take: Take, reader: Reader
    ) -> None:
        (late,) = take(Spec())
        store.release(launch)
        assert not store.fail(late, Failure("E", "m", "t"), RUN)
        assert reader.query("SELECT * FROM error") == []
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
    @pytest.mark.parametrize("reason", MALFORMED)
    def test_is_refused_whole(self, store: Store, take: Take, reader: Reader, reason: str) -> None:
        good, bad = take(Spec(0), Spec(1))
        with pytest.raises(InvalidResultError, match=reason):
            store.commit_many([(good, result(), RUN), (bad, MALFORMED[reason], RUN)])
        assert reader.query("SELECT * FROM step") == []
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
        assert len(reader.query("SELECT * FROM error")) == 1
        rows = reader.query("SELECT seed, cause, type, message, traceback FROM v_failures")
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
        rows = reader.query("SELECT attempt, outcome FROM attempt ORDER BY attempt")
        assert [tuple(row) for row in rows] == [(1, "failed"), (2, "done")]
        assert reader.query("SELECT status FROM v_failures")[0].status == "done"
        assert reader.trials(Spec().config_key)[0].error_type is None

    def test_may_say_what_no_database_takes(self, store: Store, take: Take, reader: Reader) -> None:
        (claim,) = take(Spec())
        text = "a zero \0 and the name of a file, \udcff"
        assert store.fail(claim, Failure("OSError", text, f"Traceback\n{text}"), RUN)
        (row,) = reader.query("SELECT message, traceback FROM v_failures")
        assert row.message == r"a zero \x00 and the name of a file, \udcff"
        assert row.traceback == f"Traceback\n{row.message}"
