"""Statements of another process between those of a transaction, on PostgreSQL."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event

from orchestrate.store import Failure, Reader, Store
from orchestrate.store.doctor import examine
from orchestrate.store.merge import Source, merge
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, diverged

FAILURE = Failure("ValueError", "bad", "here")


@pytest.fixture
def url(postgresql_url: str) -> str:
    return postgresql_url


@pytest.fixture
def one(open_store: Callable[..., Store]) -> Store:
    return open_store()


@pytest.fixture
def two(open_store: Callable[..., Store]) -> Store:
    return open_store()


@pytest.fixture
def interrupt() -> Iterator[Callable[..., list[Any]]]:
    """Return what calls a function once, after a store's first statement with such a beginning."""
    listeners = []

    def once(store: Store, beginning: str, action: Callable[[], Any]) -> list[Any]:
        done: list[Any] = []

        def listen(_connection: object, _cursor: object, statement: str, *_: object) -> None:
            if statement.startswith(beginning) and not done:
                done.append(None)
                done[0] = action()

        event.listen(store._backend.engine, "after_cursor_execute", listen)
        listeners.append((store._backend.engine, listen))
        return done

    yield once
    for engine, listen in listeners:
        event.remove(engine, "after_cursor_execute", listen)


@pytest.mark.parametrize("beginning", ["DELETE FROM step", "UPDATE trial"])
def test_an_outcome_that_comes_during_a_retry_keeps_its_rows(
    one: Store, two: Store, url: str, interrupt: Callable[..., list[Any]], beginning: str
) -> None:
    launch, other = one.begin_launch(LAUNCH), two.begin_launch(LAUNCH)
    keys = one.register(launch, [Spec(0), Spec(1)]).todo
    before, during = one.claim(launch, keys)
    one.commit(before, diverged(3, 0), RUN)
    committed = interrupt(two, beginning, lambda: one.commit(during, diverged(2, 1), RUN))
    assert two.retry("diverged", keys) == 1
    assert committed == [True]
    with Reader.open(url) as reader:
        statuses = {row.seed: row.status for row in reader.trials(Spec().config_key)}
    assert statuses == {0: "pending", 1: "diverged"}
    assert not [found for found in examine(url) if "steps" in found.sentence]
    (again,) = two.claim(other, keys)
    assert two.commit(again, diverged(3, 0), RUN)


def test_a_traceback_is_not_pruned_while_a_trial_comes_to_refer_to_it(
    one: Store, two: Store, interrupt: Callable[..., list[Any]]
) -> None:
    launch = one.begin_launch(LAUNCH)
    keys = one.register(launch, [Spec(0)]).todo
    one.fail(one.claim(launch, keys)[0], FAILURE, RUN)
    one.end_launch(launch, "done")
    later = one.begin_launch(LAUNCH)
    (claim,) = one.claim(later, one.register(later, [Spec(1)]).todo)
    pruned = interrupt(one, "INSERT INTO error", lambda: two.prune(keys))
    assert one.fail(claim, FAILURE, RUN)
    assert pruned == [1]


def test_a_merge_uses_the_traceback_that_a_launch_has_inserted_meanwhile(
    one: Store, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = f"sqlite:///{tmp_path}/other.db"
    with Store.open(other) as filled:
        launch = filled.begin_launch(LAUNCH)
        (failed,) = filled.claim(launch, filled.register(launch, [Spec(0)]).todo)
        filled.fail(failed, FAILURE, RUN)
        filled.end_launch(launch, "failed")
    launch = one.begin_launch(LAUNCH)
    (claim,) = one.claim(launch, one.register(launch, [Spec(1)]).todo)
    read = Source.error

    def fail_meanwhile(source: Source, digest: str) -> dict[str, Any]:
        assert one.fail(claim, FAILURE, RUN)
        return read(source, digest)

    monkeypatch.setattr(Source, "error", fail_meanwhile)
    assert merge(url, other).added == {"failed": 1}
    with Reader.open(url) as reader:
        assert len(reader.rows("SELECT * FROM error")) == 1
