"""The reader and the views, on every database."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orchestrate.store import (
    NoDatabaseError,
    QueryError,
    Reader,
    SchemaVersionError,
    Store,
    StoreError,
    StoreUnavailableError,
)
from tests.orchestrate.store.conftest import Database
from tests.orchestrate.store.databases import execute, new_schema
from tests.orchestrate.store.fakes import FAILURE, HORIZON, RUN, Spec, begin, diverged, result

KEY = Spec().config_key


def fill(url: str) -> None:
    """Of policy random: two done, one diverged, one failed; of policy d_optimal: one waits."""
    with Store.open(url) as store:
        launch, (done, other, bad, failed) = begin(store, *map(Spec, (2, 0, 1, 3)))
        store.commit(done, result(2), RUN)
        store.commit(other, result(0), RUN)
        store.commit(bad, diverged(3, seed=1), RUN)
        store.fail(failed, FAILURE, RUN)
        store.register(launch, [Spec(0, policy="d_optimal", width=None)])
        store.end_launch(launch, "done")


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def shown(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Reader]:
    """Read the grid in a database that all tests of this module share."""
    with ExitStack() as stack:
        if request.param == "sqlite":
            url = f"sqlite:///{tmp_path_factory.mktemp('shown')}/results.db"
        else:
            url = stack.enter_context(new_schema(request))
        fill(url)
        yield stack.enter_context(Reader.open(url))


def test_it_counts_the_trials_of_each_config(shown: Reader) -> None:
    first, second = shown.configs()
    assert (first.policy, first.width, first.n, first.n_pending) == ("d_optimal", None, 1, 1)
    assert (second.policy, second.config_key, second.n) == ("random", KEY, 4)
    assert (second.n_done, second.n_diverged, second.n_failed) == (2, 1, 1)
    assert (second.horizon, second.dt, second.gamma) == (HORIZON, 0.01, 1.5)
    assert second.config == Spec().columns()


def test_curves_and_trials_are_sorted_by_seed(shown: Reader) -> None:
    curves = shown.curves(KEY)
    np.testing.assert_array_equal(curves.seeds, np.array([0, 1, 2]), strict=True)
    np.testing.assert_array_equal(curves.t, np.arange(HORIZON), strict=True)
    np.testing.assert_array_equal(curves.diverged, [False, True, False])
    expected = [result(0).loss, diverged(3, seed=1).loss, result(2).loss]
    np.testing.assert_array_equal(curves.values, expected)
    waiting = shown.curves(Spec(policy="d_optimal", width=None).config_key)
    assert waiting.values.shape == (0, HORIZON)
    rows = shown.trials(KEY)
    assert [row.seed for row in rows] == [0, 1, 2, 3]
    assert [row.status for row in rows] == ["done", "diverged", "done", "failed"]
    assert rows[0].trial_key == Spec(0).trial_key
    assert shown.trials("0" * 64) == []


@pytest.mark.parametrize(
    "damage", ["DELETE FROM step WHERE t = 2", "UPDATE step SET t = 99 WHERE t = 2"]
)
def test_curves_that_are_not_whole_are_refused(url: str, damage: str) -> None:
    fill(url)
    execute(url, "DELETE FROM curve")
    execute(url, damage)
    with (
        Reader.open(url) as reader,
        pytest.raises(StoreUnavailableError, match=r"18 steps instead of 21.*doctor"),
    ):
        reader.curves(KEY)


def test_what_is_not_there_is_named(shown: Reader) -> None:
    with pytest.raises(QueryError, match="did you mean 'reachable_loss'"):
        shown.curves(KEY, "reachable")
    with pytest.raises(QueryError, match="not in the database"):
        shown.curves("0" * 64)
    with pytest.raises(QueryError, match="no trajectory of seed 3"):
        shown.trajectory(KEY, 3)
    with pytest.raises(QueryError, match="nowhere"):
        shown.query("SELECT * FROM nowhere")


def test_statistics_of_curves(shown: Reader) -> None:
    losses = shown.curves(KEY).values
    rows = shown.rows(
        "SELECT t, n, n_finite, mean, standard_error FROM v_curve_stats "
        "WHERE policy = 'random' ORDER BY t"
    )
    for t, row in enumerate(rows):
        finite = losses[np.isfinite(losses[:, t]), t]
        assert (row.t, row.n, row.n_finite) == (t, 3, len(finite))
        assert math.isclose(row.mean, finite.mean(), rel_tol=1e-12)
        expected = finite.std(ddof=1) / math.sqrt(len(finite))
        assert math.isclose(row.standard_error, expected, rel_tol=1e-9)
    assert len(rows) == HORIZON


def test_views_show_curves_trials_progress_and_failures(shown: Reader) -> None:
    steps = "SELECT env, policy, width, seed, t, loss FROM v_curve WHERE seed = 2 ORDER BY t"
    assert [tuple(row) for row in shown.rows(steps)] == [
        ("pendulum", "random", 16, 2, t, loss) for t, loss in enumerate(result(2).loss)
    ]
    assert len(shown.rows("SELECT * FROM v_trial")) == 5
    (row,) = shown.query(
        "SELECT n, n_done, n_diverged, n_failed, n_running FROM v_progress "
        "WHERE env LIKE 'pend%' AND policy = 'random' AND env <> ':x'"
    )
    assert tuple(row) == (4, 2, 1, 1, 0)
    (failure,) = shown.rows("SELECT seed, type, status FROM v_failures")
    assert tuple(failure) == (3, "ValueError", "failed")


def test_errors_of_one_seed_of_equal_curves_and_of_squares_that_overflow(db: Database) -> None:
    several = [Spec(seed, policy=policy) for policy in ("equal", "large") for seed in range(3)]
    one, *claims = db.take(Spec(0, policy="one"), *several)
    db.store.commit(one, result(), RUN)
    loss = result().loss.copy()
    loss[2] = 1e200
    for claim, spec in zip(claims, several, strict=True):
        large = {"loss": loss} if spec.policy == "large" else {}
        db.store.commit(claim, replace(result(5), **large), RUN)

    def statistics(policy: str) -> list[tuple[float, float | None]]:
        sql = "SELECT mean, standard_error FROM v_curve_stats"
        return db.rows(f"{sql} WHERE policy = '{policy}' ORDER BY t")  # type: ignore[return-value]

    assert {error for _, error in statistics("one")} == {None}
    np.testing.assert_allclose([error for _, error in statistics("equal")], 0.0, atol=1e-8)
    found = statistics("large")
    assert math.isclose(found[2][0], 1e200)
    assert [error is None for _, error in found] == [t == 2 for t in range(HORIZON)]


VIEWS = ("v_trial", "v_curve", "v_curve_stats", "v_progress", "v_failures")


def test_both_databases_show_the_same(sqlite_url: str, postgresql_url: str) -> None:
    answers = [_views(url) for url in (sqlite_url, postgresql_url)]
    assert answers[0] == answers[1]


def _views(url: str) -> dict[str, object]:
    """Return columns and rows of each view of a database that is filled first."""
    fill(url)
    shown: dict[str, object] = {}
    with Reader.open(url) as reader:
        for view in VIEWS:
            columns = [c for c in reader.rows(f"SELECT * FROM {view}")[0]._fields if c != "ended"]
            rows = reader.rows(f"SELECT {', '.join(columns)} FROM {view}")
            shown[view] = columns, sorted(map(_rounded, rows))
    return shown


def _rounded(row: tuple[object, ...]) -> list[str]:
    # Sums are taken in different orders; their last digits may differ.
    return [f"{x:.9e}" if isinstance(x, float) else repr(x) for x in row]


def test_a_reader_never_creates(tmp_path: Path, postgresql_url: str) -> None:
    with pytest.raises(NoDatabaseError, match="run a launch"):
        Reader.open(f"sqlite:///{tmp_path}/none.db")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SchemaVersionError, match="no table 'alembic_version'"):
        Reader.open(postgresql_url)


@pytest.mark.parametrize("side", [Store, Reader])
@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("results.db", "cannot be read"),
        ("mysql://me:secret@host/db", "not supported"),
        ("sqlite://", "in memory"),
        ("postgresql://me:secret@127.0.0.1:1/db", "server runs and answers"),
    ],
)
def test_it_says_what_is_wrong_with_a_url(
    side: type[Store | Reader], url: str, reason: str
) -> None:
    with pytest.raises(StoreError, match=reason) as caught:
        side.open(url)
    assert "secret" not in str(caught.value)


def test_it_hides_the_password(postgresql_url: str) -> None:
    with_password = postgresql_url.replace("postgres@", "postgres:secret@")
    with Store.open(with_password) as store, Reader.open(with_password) as reader:
        assert "secret" not in store.safe_url + reader.safe_url
        assert "postgres:***@" in reader.safe_url
