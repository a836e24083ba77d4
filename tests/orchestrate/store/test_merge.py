"""Trials of another database come in whole, once, and never over a result."""

from __future__ import annotations

import hashlib
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import text

from dopt.result import Assessment
from orchestrate.__main__ import main
from orchestrate.store import (
    NoDatabaseError,
    Reader,
    SchemaVersionError,
    Store,
    StoreError,
    StoreUnavailableError,
)
from orchestrate.store import merge as source
from orchestrate.store import schema as schema_version
from orchestrate.store.maintenance import examine
from orchestrate.store.merge import Merged, merge
from orchestrate.store.schema import metadata
from tests.orchestrate.store.conftest import Database, each_other
from tests.orchestrate.store.databases import execute
from tests.orchestrate.store.fakes import (
    FAILURE,
    LAUNCH,
    RUN,
    FakeResult,
    Spec,
    assessed,
    begin,
    diverged,
    everything,
    result,
    run_all,
)
from tests.orchestrate.store.processes import hear, kill, merge_and_tell, running

KEY = Spec().config_key


def fill(url: str, *specs: Spec, offset: int = 0) -> None:
    """Run trials: of four, one diverges and one fails, and the last one of all stays pending."""
    with Store.open(url) as store:
        launch, claims = begin(store, *specs)
        for spec, claim in zip(specs[:-1], claims, strict=False):
            number = spec.seed + offset
            if spec.seed % 4 == 1:
                store.commit(claim, diverged(3, seed=number), RUN)
            elif spec.seed % 4 == 2:
                store.fail(claim, FAILURE, RUN)
            else:
                store.commit(claim, result(number, spec.horizon), RUN)
        store.end_launch(launch, "failed", exit_code=1)


def outcomes(url: str) -> list[list[str]]:
    """Return all that is in a database, without the trials that wait."""
    found = everything(url)
    found[0] = [row for row in found[0] if "'pending'" not in row]
    found[3] = [row for row in found[3] if "'released'" not in row]
    return found


def seeds(*numbers: int, policy: str = "random") -> list[Spec]:
    return [Spec(seed, policy=policy) for seed in numbers]


@each_other
@pytest.mark.parametrize("steps", [1, 25, source.PAGE_STEPS])
def test_an_empty_database_becomes_a_copy(
    url: str, other: str, monkeypatch: pytest.MonkeyPatch, steps: int
) -> None:
    monkeypatch.setattr(source, "PAGE_STEPS", steps)
    fill(other, *seeds(*range(9)), Spec(99))
    found = merge(url, other)
    assert found == Merged(added={"done": 5, "diverged": 2, "failed": 2}, launches=1)
    assert everything(url) == outcomes(other)


def test_again_changes_nothing(url: str, other: str) -> None:
    fill(url, *seeds(50, 51, 52), Spec(99))
    fill(other, *seeds(*range(9)), Spec(99))
    merge(url, other)
    before = everything(url)
    again = merge(url, other)
    assert (again.identical, again.kept, again.changed) == (7, 2, False)
    assert everything(url) == before


def test_numbers_are_given_again(url: str, other: str) -> None:
    fill(url, *seeds(10, 11, 12), Spec(99))
    fill(other, *seeds(2, 1, 0, policy="uniform"), *seeds(0, 1), Spec(99))
    merge(url, other)
    with Reader.open(url) as reader:
        assert reader.curves(KEY).seeds.tolist() == [0, 1, 11, 12]
        uniform = Spec(policy="uniform").config_key
        np.testing.assert_array_equal(reader.curves(uniform).values[0], result(0).loss)
        np.testing.assert_array_equal(reader.trajectory(KEY, 0).states, result(0).states)
        failures = reader.rows("SELECT seed, policy FROM v_failures ORDER BY seed")
        assert [tuple(row) for row in failures] == [(2, "uniform"), (10, "random")]
    with Store.open(url) as store:
        fresh = store.begin_launch(LAUNCH)
        assert store.register(fresh, [Spec(77)]).todo == [Spec(77).trial_key]


@each_other
def test_equal_numbers_are_one_trial_and_others_a_conflict(url: str, other: str) -> None:
    fill(url, *seeds(0, 3, 4, 1), Spec(99))
    fill(other, *seeds(0, 1, 5), Spec(99))
    fill(other, *seeds(3), Spec(99), offset=1000)
    before = everything(url)[1]
    found = merge(url, other)
    assert found.added == {"diverged": 1}
    assert found.identical == 2
    assert [(one.trial_key, one.seed) for one in found.conflicts] == [(Spec(3).trial_key, 3)]
    assert set(before) <= set(everything(url)[1])
    with Reader.open(url) as reader:
        np.testing.assert_array_equal(reader.curves(KEY).values[2], result(3).loss)


def test_times_of_equal_trials_may_differ(url: str, other: str) -> None:
    fill(url, *seeds(0), Spec(99))
    with Store.open(other) as store:
        _, (claim,) = begin(store, *seeds(0))
        store.commit(claim, replace(result(0), plan_us=np.ones(7)), replace(RUN, node="there"))
    assert merge(url, other).identical == 1


def test_any_other_number_is_a_conflict(tmp_path: Path) -> None:
    url, other = (f"sqlite:///{tmp_path}/{i}.db" for i in range(2))
    names = ("states", "inputs", "parameters", "loss", "reachable_loss")

    def changed(spec: Spec) -> FakeResult:
        name = names[spec.seed]
        values = getattr(result(spec.seed), name).copy()
        values.flat[-1] = np.nextafter(values.flat[-1], 2)
        return replace(result(spec.seed), **{name: values})

    run_all(url, *seeds(*range(5)))
    run_all(other, *seeds(*range(5)), make=changed)
    assert [one.seed for one in merge(url, other).conflicts] == [*range(5)]


def test_a_result_takes_the_place_of_a_failure_and_not_the_other_way(url: str, other: str) -> None:
    with Store.open(url) as store:
        launch, (failed, done, waits) = begin(store, *seeds(0, 4, 8))
        store.fail(failed, FAILURE, RUN)
        store.commit(done, result(4), RUN)
        store.release(launch, [waits.trial_key])
        store.end_launch(launch, "failed")
    with Store.open(other) as store:
        launch, claims = begin(store, *seeds(0, 4, 8))
        store.commit(claims[0], result(0), RUN)
        for claim in claims[1:]:
            store.fail(claim, FAILURE, RUN)
    found = merge(url, other)
    assert found.added == {"done": 1, "failed": 1}
    assert found.kept == 1
    with Reader.open(url) as reader:
        rows = reader.trials(KEY)
        assert [row.status for row in rows] == ["done", "done", "failed"]
        assert [row.error_type for row in rows] == [None, None, "ValueError"]
        attempts = reader.rows(
            "SELECT seed, a.attempt, outcome FROM attempt a JOIN trial r ON r.trial_id = a.trial_id"
            " ORDER BY seed, a.attempt"
        )
        assert [tuple(row) for row in attempts] == [
            (0, 1, "failed"), (0, 2, "done"), (4, 1, "done"), (8, 1, "released"), (8, 2, "failed")
        ]  # fmt: skip
        assert [row.attempt for row in rows] == [2, 1, 2]


def test_what_is_to_run_again_does_not_come_back(url: str, other: str) -> None:
    fill(other, *seeds(1, 2), Spec(99))
    merge(url, other)
    with Store.open(url) as store:
        assert store.retry("all") == 2
    assert merge(url, other).kept == 2
    assert execute(url, "SELECT DISTINCT status FROM trial") == [("pending",)]


def test_what_a_launch_runs_here_is_left_to_it(db: Database, other: str) -> None:
    (claim,) = db.take(Spec(0))
    fill(other, *seeds(0, 3), Spec(99))
    found = merge(db.url, other)
    assert (found.running, found.added) == (1, {"done": 1})
    assert db.store.commit(claim, result(0), RUN)
    assert merge(db.url, other).identical == 2


def test_what_runs_there_does_not_run_here(url: str, other: str) -> None:
    with Store.open(other) as store:
        launch, (one, two) = begin(store, *seeds(0, 3))
        store.commit(one, result(0), RUN)
        assert merge(url, other).added == {"done": 1}
        assert _launches(url) == [("lost", None, None)]
        store.commit(two, result(3), RUN)
        store.end_launch(launch, "done", exit_code=0)
    found = merge(url, other)
    assert (found.added, found.launches) == ({"done": 1}, 0)
    assert _launches(url) == _launches(other)
    assert everything(url) == everything(other)


def _launches(url: str) -> list[tuple[object, ...]]:
    with Reader.open(url) as reader:
        return [tuple(row) for row in reader.rows("SELECT state, ended, exit_code FROM launch")]


def test_only_whole_trials_come(url: str, other: str) -> None:
    run_all(other, *seeds(*range(6)), make=lambda one: assessed(one.seed))
    numbers = execute(other, "SELECT trial_id FROM trial WHERE seed < 5 ORDER BY seed")
    damage = ("step WHERE t = 3", "step WHERE t >= 0", "trajectory WHERE true",
              "assessment WHERE t = 3", "assessment WHERE true")  # fmt: skip
    for (trial_id,), rows in zip(numbers, damage, strict=True):
        execute(other, f"DELETE FROM {rows} AND trial_id = {trial_id}")
    found = merge(url, other)
    assert sorted(one.seed for one in found.incomplete) == [0, 1, 2, 3, 4]
    assert found.added == {"done": 1}
    assert execute(url, "SELECT seed FROM trial") == [(5,)]


def test_a_merge_that_was_killed_is_completed(
    url: str, other: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "PAGE", 3)
    fill(other, *seeds(*range(12)), Spec(99))
    with running(merge_and_tell, url, other, 7) as (process, pipe):
        assert hear(pipe) == "in the middle"
        kill(process)
    with Reader.open(url) as reader:
        assert len(reader.rows("SELECT * FROM trial")) == 6
    found = merge(url, other)
    assert sum(found.added.values()) == 6
    assert everything(url) == outcomes(other)


def test_memory_does_not_grow_with_the_rows(tmp_path: Path) -> None:
    url, other = (f"sqlite:///{tmp_path}/{i}.db" for i in range(2))
    horizon, count = 2_000, 100
    run_all(other, *(Spec(seed, horizon=horizon) for seed in range(count)))
    with running(_merge_and_measure, url, other) as (_, pipe):
        added, kilobytes = hear(pipe)
    assert added == {"done": count}
    # 200,000 rows of five numbers are 24 MB as Python objects in a list of tuples.
    assert kilobytes < 15_000


def _merge_and_measure(pipe, url: str, other: str) -> None:  # type: ignore[no-untyped-def]
    Store.open(url).close()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = merge(url, other)
    pipe.send((found.added, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))


@each_other
def test_refuses_itself_and_nothing(url: str, other: str, store: Store) -> None:  # noqa: ARG001
    with pytest.raises(StoreError, match="Both databases"):
        merge(url, url)
    if other.startswith("sqlite"):
        with pytest.raises(NoDatabaseError):
            merge(url, other)


def test_another_assessment_is_a_conflict(url: str, other: str) -> None:
    for where in (url, other):
        run_all(where, Spec(0), make=lambda one: assessed(one.seed))
    execute(other, "UPDATE assessment SET value = 9 WHERE t = 3")
    assert [one.seed for one in merge(url, other).conflicts] == [0]


def test_a_sample_loss_may_be_stored_of_some_trials_alone(url: str, other: str) -> None:
    run_all(other, Spec(0), Spec(1), make=lambda one: assessed(one.seed))
    found = {Spec(0).trial_key: Assessment(7, schema_version.SAMPLE_LOSS, 0.5)}
    with Store.open(other) as store:
        assert store.add_assessments(found) == 1
    assert not any("assessments" in one.sentence for one in examine(other))
    assert merge(url, other).added == {"done": 2}
    assert everything(url) == everything(other)
    with Store.open(other) as store:
        store.add_assessments({Spec(1).trial_key: Assessment(7, schema_version.SAMPLE_LOSS, 2.0)})
    again = merge(url, other)
    assert (again.identical, again.conflicts) == (2, [])


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i FROM n"


def fill_strangers(url: str) -> None:
    run_all(url, Spec(0), Spec(1), Spec(2, policy="d_optimal"))


def test_a_table_that_is_a_view_is_refused(url: str) -> None:
    fill_strangers(url)
    for table in metadata.tables:
        execute(url, f"ALTER TABLE {table} RENAME TO other")
        execute(url, f"CREATE VIEW {table} AS SELECT * FROM other WHERE EXISTS ({ENDLESS})")
        for side in (Reader, Store):
            with pytest.raises(SchemaVersionError, match="is not a results database of this prog"):
                side.open(url)
        execute(url, f"DROP VIEW {table}")
        execute(url, f"ALTER TABLE other RENAME TO {table}")
    Reader.open(url).close()


@pytest.mark.parametrize(
    "change",
    [
        "ALTER TABLE launch ADD COLUMN slow TEXT GENERATED ALWAYS AS (token || token) {stored}",
        "ALTER TABLE step RENAME COLUMN loss TO losses",
        "ALTER TABLE config DROP COLUMN gamma",
    ],
)
def test_a_table_of_other_columns_is_refused(url: str, change: str) -> None:
    fill_strangers(url)
    for view in ("v_curve_stats", "v_curve", "v_progress", "v_failures", "v_assessment", "v_trial"):
        execute(url, f"DROP VIEW {view}")
    execute(url, change.format(stored="STORED" if url.startswith("postgres") else "VIRTUAL"))
    with pytest.raises(SchemaVersionError, match=r"is no table, or has other columns\): give"):
        Reader.open(url)


def test_a_table_without_types_is_refused(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/r.db"
    fill_strangers(url)
    execute(url, "ALTER TABLE curve RENAME TO other")
    execute(url, "CREATE TABLE curve AS SELECT * FROM other")
    with pytest.raises(SchemaVersionError, match="curve is no table"):
        Reader.open(url)


def test_views_of_a_file_are_not_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    url, mine = f"sqlite:///{tmp_path}/r.db", f"sqlite:///{tmp_path}/mine.db"
    fill_strangers(url)
    for view in ("v_progress", "v_trial", "v_failures", "v_assessment"):
        execute(url, f"DROP VIEW {view}")
        execute(url, f"CREATE VIEW {view} AS {ENDLESS}")
    assert main(["status", "--db", url]) == 0
    assert main(["show", "--db", url, "--seed", "1"]) == 0
    assert main(["merge", url, "--db", mine]) == 0
    assert "copied 3 trials (3 done)" in capsys.readouterr().out


def test_the_check_ends(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fill_strangers(url)
    monkeypatch.setattr(schema_version, "CHECK_SECONDS", 0.05)
    monkeypatch.setattr(
        schema_version, "_check_tables", lambda one, _: one.execute(text(ENDLESS)).all()
    )
    with pytest.raises(StoreUnavailableError, match=r"cannot be used.*(interrupt|timeout)"):
        Reader.open(url)


CHANGES = {
    "another seed": "trial SET seed = 77",
    "another key": "trial SET trial_key = 'f00'",
    "more states": "trajectory SET states_shape = '[9, 4]'",
    "another order": "trajectory SET inputs_shape = '[2, 7]'",
    "no shape": "trajectory SET states_shape = '[-1, 4]'",
    "no numbers": "trajectory SET states_shape = '[\"8\", 4]'",
    "a number": "trajectory SET parameters_shape = '[]'",
    "no JSON": "trajectory SET parameters_shape = '11'",
    "brackets": f"trajectory SET parameters_shape = '{100_000 * '['}'",
    "a matrix": "trajectory SET parameters_shape = '[11, 1]'",
    "another type": "trajectory SET dtype = '<f4'",
    "a blob too short": "trajectory SET inputs = parameters",
}


def test_trials_that_contradict_themselves_stay_out(url: str, other: str) -> None:
    run_all(other, *map(Spec, range(len(CHANGES) + 1)))
    numbers = execute(other, "SELECT trial_id FROM trial WHERE seed > 0 ORDER BY seed")
    for (trial_id,), change in zip(numbers, CHANGES.values(), strict=True):
        execute(other, f"UPDATE {change} WHERE trial_id = {trial_id}")
    found = merge(url, other)
    assert (found.added, len(found.contradictory)) == ({"done": 1}, len(CHANGES))
    assert execute(url, "SELECT trial_key FROM trial") == [(Spec(0).trial_key,)]


@pytest.mark.parametrize("key", [False, True])
def test_a_configuration_that_is_not_that_of_its_key_stays_out(
    url: str, other: str, key: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    fill_strangers(other)
    new = "{}" if key else None
    digest = hashlib.sha256(b"{}").hexdigest()
    where = "WHERE policy = 'random'"
    changed = f"config_json = '{new}', config_key = '{digest}'" if key else "config_json = '{}'"
    execute(other, f"UPDATE config SET {changed} {where}")
    assert main(["merge", other, "--db", url]) == 1
    output = capsys.readouterr().out
    assert "copied 1 trial (1 done)\n2 contradict their keys or the shapes of" in output
    assert execute(url, "SELECT policy FROM config") == [("d_optimal",)]


@pytest.mark.parametrize(
    "change",
    [
        "launch SET argv = 'x'",
        "launch SET versions = '[]'",
        f"launch SET overrides = '{50_000 * '['}'",
        "config SET config_json = '{'",
    ],
    ids=lambda change: change[:30],
)
def test_a_text_that_is_no_json_is_a_sentence(
    sqlite_url: str, tmp_path: Path, change: str, capsys: pytest.CaptureFixture[str]
) -> None:
    fill_strangers(sqlite_url)
    execute(sqlite_url, f"UPDATE {change}")
    for words in (["status"], ["show", "--seed", "2"]):
        assert main([*words, "--db", sqlite_url]) == 2
        assert "in the place of JSON: it was changed by hand" in capsys.readouterr().err
    code = main(["merge", sqlite_url, "--db", f"sqlite:///{tmp_path}/mine.db"])
    assert code == (1 if change.startswith("config") else 2)


def test_an_array_that_is_damaged_is_a_sentence(
    sqlite_url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fill_strangers(sqlite_url)
    execute(sqlite_url, "UPDATE trajectory SET states_shape = '[1]'")
    assert main(["export", "trajectories", f"{tmp_path}/x.csv", "--db", sqlite_url]) == 2
    assert "An array of the database is damaged (cannot reshape" in capsys.readouterr().err
