"""Operations on a database that loses requests and answers: each is done once."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from orchestrate.runner.saving import IDEMPOTENT, Patience, RetryingStore
from orchestrate.store import InvalidResultError, Store
from orchestrate.store import StoreUnavailableError as UnavailableError
from tests.orchestrate.losses import lose
from tests.orchestrate.store.conftest import Database
from tests.orchestrate.store.fakes import FAILURE, LAUNCH, RUN, Spec, result
from tests.waiting import PATIENCE_SECONDS

SPECS = [Spec(seed) for seed in range(6)]


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("orchestrate.runner.saving.FIRST_PAUSE_SECONDS", 0.01)


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def patient(db: Database, said: list[str]) -> RetryingStore:
    return RetryingStore(db.store, db.launch, Patience(PATIENCE_SECONDS, said.append))


@pytest.mark.parametrize("name", IDEMPOTENT)
def test_an_idempotent_operation_takes_the_launch_where_the_table_says_so(name: str) -> None:
    first = [*inspect.signature(getattr(Store, name)).parameters][1:2]
    assert (first == ["launch"]) == IDEMPOTENT[name]


@pytest.mark.parametrize(
    "lost", [["question", "answer"], ["answer", "question", "answer", "answer"]], ids="-".join
)
def test_each_operation_is_done_once_and_takes_nothing_from_others(
    patient: RetryingStore, db: Database, monkeypatch: pytest.MonkeyPatch, lost: list[str]
) -> None:
    def losing(operation: Callable[..., Any], *arguments: object) -> Any:
        with monkeypatch.context() as patch:
            lose(patch, lost)
            return operation(*arguments)

    todo = patient.register(SPECS).todo
    [held] = patient.claim(todo[:1])
    other = db.store.begin_launch(LAUNCH)
    [theirs] = db.store.claim(other, todo[1:2])
    claims = losing(patient.claim, todo[1:])
    assert [claim.trial_key for claim in claims] == todo[2:]
    running = db.rows("SELECT trial_id, attempt FROM attempt WHERE outcome IS NULL")
    expected = [(one.trial_id, one.attempt) for one in (held, theirs, *claims)]
    assert sorted(running) == sorted(expected)
    late, failed, *done = claims
    db.store.release(db.launch, [late.trial_key])
    [taken] = db.store.claim(other, [late.trial_key])
    assert db.store.commit(taken, result(7), RUN)
    assert db.store.commit(theirs, result(1), RUN)
    sent = [(claim, result(claim.trial_id), RUN) for claim in (late, held, *done)]
    assert losing(patient.commit, sent) == [False, True, True, True]
    assert losing(patient.fail, failed, FAILURE, RUN)
    assert len(db.rows("SELECT * FROM v_failures")) == 1
    losses = [result(held.trial_id).loss, result(1).loss, result(7).loss]
    losses += [result(claim.trial_id).loss for claim in done]
    np.testing.assert_array_equal(db.curves().values, losses)
    found = losing(patient.final_losses, todo)
    assert sorted(found.values()) == sorted(loss[-1] for loss in losses)


def test_a_failure_that_comes_too_late(
    patient: RetryingStore, db: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    [claim] = patient.claim(patient.register(SPECS[:1]).todo)
    db.store.release(db.launch)
    lose(monkeypatch, ["question"])
    assert not patient.fail(claim, FAILURE, RUN)


def test_it_says_once_that_it_waits_and_for_how_long(
    patient: RetryingStore, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lose(monkeypatch, ["question"] * 3)
    patient.recover()
    assert said[0] == "waiting for up to 600 s: recover was lost."
    assert said[1].startswith("the database is back after ")
    assert len(said) == 2


def test_what_waiting_cannot_help_is_raised_at_once(
    patient: RetryingStore, db: Database, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    [claim] = db.take(Spec(0))
    with pytest.raises(InvalidResultError):
        patient.commit([(claim, result(horizon=2), RUN)])
    lose(monkeypatch, ["question", "", ""], transient=False)
    with pytest.raises(UnavailableError, match="recover was lost"):
        patient.recover()
    assert said == []
