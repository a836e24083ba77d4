"""View of a reader while launches run: who lives, and one moment of everything."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace

from orchestrate.store import Claim, Reader, Store
from tests.orchestrate.store.fakes import HORIZON, LAUNCH, RUN, Spec, result

Take = Callable[..., list[Claim]]


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
