"""The reader and the views, on every database."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orchestrate.store import (
    Claim,
    Failure,
    NoDatabaseError,
    QueryError,
    Reader,
    SchemaVersionError,
    Store,
    StoreError,
    StoreUnavailableError,
)
from tests.orchestrate.store.databases import new_schema
from tests.orchestrate.store.fakes import HORIZON, LAUNCH, RUN, Spec, begin, diverged, result

Take = Callable[..., list[Claim]]
KEY = Spec().config_key


def fill_grid(store: Store) -> None:
    """Of policy random: two done, one diverged, one failed; of policy d_optimal: one waits."""
    launch, (done, other, bad, failed) = begin(store, *map(Spec, (2, 0, 1, 3)))
    store.commit(done, result(2), RUN)
    store.commit(other, result(0), RUN)
    store.commit(bad, diverged(3, seed=1), RUN)
    store.fail(failed, Failure("ValueError", "no", "Traceback"), RUN)
    store.register(launch, [Spec(0, policy="d_optimal", width=None)])


@pytest.fixture
def grid(store: Store) -> None:
    fill_grid(store)


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
        with Store.open(url) as store:
            fill_grid(store)
            yield stack.enter_context(Reader.open(url))


class TestReader:
    def test_counts_the_trials_of_each_config(self, shown: Reader) -> None:
        first, second = shown.configs()
        assert (first.policy, first.width, first.n, first.n_pending) == ("d_optimal", None, 1, 1)
        assert (second.policy, second.config_key, second.n) == ("random", KEY, 4)
        assert (second.n_done, second.n_diverged, second.n_failed) == (2, 1, 1)
        assert (second.horizon, second.dt, second.gamma) == (HORIZON, 0.01, 1.5)
        assert second.config == Spec().columns()

    def test_sorts_curves_by_seed(self, shown: Reader) -> None:
        curves = shown.curves(KEY)
        np.testing.assert_array_equal(curves.seeds, np.array([0, 1, 2]), strict=True)
        np.testing.assert_array_equal(curves.t, np.arange(HORIZON), strict=True)
        np.testing.assert_array_equal(curves.diverged, [False, True, False], strict=False)
        expected = [result(0).loss, diverged(3, seed=1).loss, result(2).loss]
        np.testing.assert_array_equal(curves.values, expected)

    @pytest.mark.usefixtures("grid")
    @pytest.mark.parametrize(
        "damage", ["DELETE FROM step WHERE t = 2", "UPDATE step SET t = 99 WHERE t = 2"]
    )
    def test_refuses_curves_that_are_not_whole(
        self, store: Store, reader: Reader, damage: str
    ) -> None:
        with store._backend.transaction() as connection:
            connection.exec_driver_sql("DELETE FROM curve")
            connection.exec_driver_sql(damage)
        with pytest.raises(StoreUnavailableError, match=r"18 steps instead of 21.*doctor"):
            reader.curves(KEY)

    def test_has_no_curves_of_trials_that_wait(self, shown: Reader) -> None:
        curves = shown.curves(Spec(policy="d_optimal", width=None).config_key)
        assert curves.values.shape == (0, HORIZON)

    def test_lists_trials_by_seed(self, shown: Reader) -> None:
        rows = shown.trials(KEY)
        assert [row.seed for row in rows] == [0, 1, 2, 3]
        assert [row.status for row in rows] == ["done", "diverged", "done", "failed"]
        assert rows[0].trial_key == Spec(0).trial_key
        assert shown.trials("0" * 64) == []

    def test_names_the_nearest_column(self, shown: Reader) -> None:
        with pytest.raises(QueryError, match="did you mean 'reachable_loss'"):
            shown.curves(KEY, "reachable")

    def test_says_what_is_not_there(self, shown: Reader) -> None:
        with pytest.raises(QueryError, match="not in the database"):
            shown.curves("0" * 64)
        with pytest.raises(QueryError, match="no trajectory of seed 3"):
            shown.trajectory(KEY, 3)

    def test_answers_questions_in_sql(self, shown: Reader) -> None:
        (row,) = shown.query(
            "SELECT policy, n_pending FROM v_progress WHERE env LIKE 'pend%'"
            " AND policy = 'd_optimal' AND env <> ':x'"
        )
        assert (row.policy, row[1]) == ("d_optimal", 1)
        with pytest.raises(QueryError, match="nowhere"):
            shown.query("SELECT * FROM nowhere")


class TestViews:
    def test_statistics_of_curves(self, shown: Reader) -> None:
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

    def test_curve(self, shown: Reader) -> None:
        rows = shown.rows(
            "SELECT env, policy, width, seed, t, loss FROM v_curve WHERE seed = 2 ORDER BY t"
        )
        assert [tuple(row) for row in rows] == [
            ("pendulum", "random", 16, 2, t, loss) for t, loss in enumerate(result(2).loss)
        ]

    def test_trial_and_progress_and_failures(self, shown: Reader) -> None:
        assert len(shown.rows("SELECT * FROM v_trial")) == 5
        (row,) = shown.rows("SELECT * FROM v_progress WHERE policy = 'random'")
        assert (row.n, row.n_done, row.n_diverged, row.n_failed, row.n_running) == (4, 2, 1, 1, 0)
        (failure,) = shown.rows("SELECT seed, type, status FROM v_failures")
        assert tuple(failure) == (3, "ValueError", "failed")

    def test_one_seed_has_no_standard_error(self, store: Store, take: Take, reader: Reader) -> None:
        (claim,) = take(Spec(0, policy="uniform"))
        store.commit(claim, result(), RUN)
        (row,) = reader.rows(
            "SELECT n_finite, standard_error FROM v_curve_stats WHERE policy='uniform' AND t=0"
        )
        assert tuple(row) == (1, None)

    def test_losses_whose_square_overflows_have_no_error(
        self, store: Store, take: Take, reader: Reader
    ) -> None:
        for claim in take(*(Spec(seed, policy="uniform") for seed in range(3))):
            loss = result().loss.copy()
            loss[2] = 1e200
            store.commit(claim, replace(result(), loss=loss), RUN)
        rows = reader.rows(
            "SELECT mean, standard_error FROM v_curve_stats WHERE policy = 'uniform' ORDER BY t"
        )
        assert math.isclose(rows[2].mean, 1e200)
        assert [row.standard_error is None for row in rows] == [t == 2 for t in range(HORIZON)]

    def test_equal_curves_have_no_error(self, store: Store, take: Take, reader: Reader) -> None:
        for claim in take(*(Spec(seed, policy="uniform") for seed in range(3))):
            store.commit(claim, result(5), RUN)
        rows = reader.rows("SELECT standard_error FROM v_curve_stats WHERE policy = 'uniform'")
        np.testing.assert_allclose([row[0] for row in rows], 0.0, atol=1e-8)


VIEWS = ("v_trial", "v_curve", "v_curve_stats", "v_progress", "v_failures")


def _fill(url: str) -> None:
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        specs = [Spec(seed, policy=policy) for policy in ("a", "b") for seed in range(4)]
        claims = store.claim(launch, store.register(launch, specs).todo)
        for i, claim in enumerate(claims[:-2]):
            store.commit(claim, diverged(2, seed=i) if i % 3 == 1 else result(i), RUN)
        store.fail(claims[-2], Failure("ValueError", "no", "Traceback"), RUN)


def test_both_databases_show_the_same(sqlite_url: str, postgresql_url: str) -> None:
    answers = [_views(url) for url in (sqlite_url, postgresql_url)]
    assert answers[0] == answers[1]


def _views(url: str) -> dict[str, object]:
    """Return columns and rows of each view of a database that is filled first."""
    _fill(url)
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


class TestOpening:
    def test_a_reader_never_creates(self, tmp_path: Path) -> None:
        with pytest.raises(NoDatabaseError, match="run a launch"):
            Reader.open(f"sqlite:///{tmp_path}/none.db")
        assert list(tmp_path.iterdir()) == []

    def test_an_empty_schema_is_no_database(self, postgresql_url: str) -> None:
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
    def test_says_what_is_wrong_with_a_url(
        self, side: type[Store | Reader], url: str, reason: str
    ) -> None:
        with pytest.raises(StoreError, match=reason) as caught:
            side.open(url)
        assert "secret" not in str(caught.value)

    def test_hides_the_password(self, postgresql_url: str) -> None:
        with_password = postgresql_url.replace("postgres@", "postgres:secret@")
        with Store.open(with_password) as store, Reader.open(with_password) as reader:
            assert "secret" not in store.safe_url + reader.safe_url
            assert "postgres:***@" in reader.safe_url
