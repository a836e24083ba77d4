"""Operations on a database that loses requests and answers: each is done once."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable

import numpy as np
import pytest

from orchestrate.runner.saving import IDEMPOTENT, RetryingStore
from orchestrate.store import Claim, Failure, InvalidResultError, Reader, Store
from orchestrate.store import StoreUnavailableError as UnavailableError
from tests.orchestrate.losses import lose
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result
from tests.waiting import PATIENCE_SECONDS

FAILURE = Failure("ZeroDivisionError", "no", "here")
LOSSES = (["question", "answer"], ["answer", "question", "answer", "answer"])
SPECS = [Spec(seed) for seed in range(4)]

losses = pytest.mark.parametrize("lost", LOSSES, ids="-".join)


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("orchestrate.runner.saving.FIRST_PAUSE_SECONDS", 0.01)


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def patient(store: Store, launch: int, said: list[str]) -> RetryingStore:
    return RetryingStore(store, launch, PATIENCE_SECONDS, said.append)


@pytest.mark.parametrize("name", IDEMPOTENT)
def test_an_idempotent_operation_takes_the_launch_where_the_table_says_so(name: str) -> None:
    first = [*inspect.signature(getattr(Store, name)).parameters][1:2]
    assert (first == ["launch"]) == IDEMPOTENT[name]


@losses
def test_a_claim(
    patient: RetryingStore, reader: Reader, monkeypatch: pytest.MonkeyPatch, lost: list[str]
) -> None:
    todo = patient.register(SPECS).todo
    lose(monkeypatch, lost)
    claims = patient.claim(todo)
    assert [claim.trial_key for claim in claims] == todo
    open_attempts = reader.rows("SELECT trial_id, attempt FROM attempt WHERE outcome IS NULL")
    assert sorted(map(tuple, open_attempts)) == sorted((c.trial_id, c.attempt) for c in claims)


@losses
def test_a_claim_takes_nothing_from_others(
    patient: RetryingStore, store: Store, monkeypatch: pytest.MonkeyPatch, lost: list[str]
) -> None:
    todo = patient.register(SPECS).todo
    [held] = patient.claim(todo[:1])
    [theirs] = store.claim(store.begin_launch(LAUNCH), todo[1:2])
    lose(monkeypatch, lost)
    assert [claim.trial_key for claim in patient.claim(todo[1:])] == todo[2:]
    assert store.commit(theirs, result(), RUN)
    assert patient.commit([(held, result(), RUN)]) == [True]


@losses
def test_a_commit(
    patient: RetryingStore, reader: Reader, monkeypatch: pytest.MonkeyPatch, lost: list[str]
) -> None:
    claims = patient.claim(patient.register(SPECS).todo)
    lose(monkeypatch, lost)
    assert patient.commit([(claim, result(claim.trial_id), RUN) for claim in claims]) == [True] * 4
    curves = reader.curves(SPECS[0].config_key)
    np.testing.assert_array_equal(curves.values, [result(claim.trial_id).loss for claim in claims])


@losses
def test_a_commit_that_comes_too_late(
    patient: RetryingStore, store: Store, launch: int, monkeypatch: pytest.MonkeyPatch,
    lost: list[str],
) -> None:  # fmt: skip
    todo = patient.register(SPECS[:2]).todo
    claims = patient.claim(todo)
    store.release(launch, todo[:1])
    other = store.begin_launch(LAUNCH)
    [theirs] = store.claim(other, todo[:1])
    assert store.commit(theirs, result(7), RUN)
    lose(monkeypatch, lost)
    assert patient.commit([(claim, result(), RUN) for claim in claims]) == [False, True]


@losses
def test_a_failure(
    patient: RetryingStore, reader: Reader, monkeypatch: pytest.MonkeyPatch, lost: list[str]
) -> None:
    [claim] = patient.claim(patient.register(SPECS[:1]).todo)
    lose(monkeypatch, lost)
    assert patient.fail(claim, FAILURE, RUN)
    assert len(reader.rows("SELECT * FROM v_failures")) == 1


@losses
def test_final_losses(
    patient: RetryingStore, monkeypatch: pytest.MonkeyPatch, lost: list[str]
) -> None:
    claims = patient.claim(patient.register(SPECS).todo)
    patient.commit([(claim, result(claim.trial_id), RUN) for claim in claims[:2]])
    lose(monkeypatch, lost)
    found = patient.final_losses([spec.trial_key for spec in SPECS])
    assert found == {one.trial_key: result(one.trial_id).loss[-1] for one in claims[:2]}


def test_a_failure_that_comes_too_late(
    patient: RetryingStore, store: Store, launch: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    [claim] = patient.claim(patient.register(SPECS[:1]).todo)
    store.release(launch)
    lose(monkeypatch, ["question"])
    assert not patient.fail(claim, FAILURE, RUN)


def test_a_malformed_result_is_not_waited_for(
    patient: RetryingStore, take: Callable[..., list[Claim]], said: list[str]
) -> None:
    [claim] = take(Spec(0))
    with pytest.raises(InvalidResultError):
        patient.commit([(claim, result(horizon=2), RUN)])
    assert said == []


def test_it_says_once_that_it_waits_and_for_how_long(
    patient: RetryingStore, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lose(monkeypatch, ["question"] * 3)
    patient.recover()
    assert said[0] == "waiting for up to 600 s: recover was lost."
    assert said[1].startswith("the database is back after ")
    assert len(said) == 2


def test_patience_ends(
    store: Store, launch: int, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lose(monkeypatch, ["question"] * 1000)
    start = time.monotonic()
    with pytest.raises(UnavailableError, match="recover was lost"):
        RetryingStore(store, launch, 0.5, said.append).recover()
    assert time.monotonic() - start >= 0.5


def test_what_waiting_cannot_help_is_raised_at_once(
    patient: RetryingStore, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lose(monkeypatch, ["question", "", ""], transient=False)
    with pytest.raises(UnavailableError, match="recover was lost"):
        patient.recover()
    assert said == []
