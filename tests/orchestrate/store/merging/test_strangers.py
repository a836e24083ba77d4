"""Databases of strangers: checked before they are read, and trials that contradict themselves."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from sqlalchemy import text

from orchestrate.__main__ import main
from orchestrate.commands.maintenance import trial_key
from orchestrate.store import Reader, SchemaVersionError, Store, StoreUnavailableError
from orchestrate.store import schema as schema_version
from orchestrate.store.merge import merge
from orchestrate.store.schema import metadata
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result
from tests.orchestrate.store.places import execute

ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i FROM n"


def fill(url: str) -> None:
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        specs = [Spec(0), Spec(1), Spec(2, policy="d_optimal")]
        for claim in store.claim(launch, store.register(launch, specs).todo):
            store.commit(claim, result(claim.trial_id), RUN)
        store.end_launch(launch, "done", exit_code=0)


@pytest.mark.parametrize("table", metadata.tables)
def test_a_table_that_is_a_view_is_refused(url: str, table: str) -> None:
    fill(url)
    execute(url, f"ALTER TABLE {table} RENAME TO other")
    execute(url, f"CREATE VIEW {table} AS SELECT * FROM other WHERE EXISTS ({ENDLESS})")
    with pytest.raises(SchemaVersionError, match="is not a results database of this program"):
        Reader.open(url)
    with pytest.raises(SchemaVersionError, match="is not a results database of this program"):
        Store.open(url)


@pytest.mark.parametrize(
    "change",
    [
        "ALTER TABLE launch ADD COLUMN slow TEXT GENERATED ALWAYS AS (token || token) {stored}",
        "ALTER TABLE step RENAME COLUMN loss TO losses",
        "ALTER TABLE config DROP COLUMN gamma",
    ],
)
def test_a_table_of_other_columns_is_refused(url: str, change: str) -> None:
    fill(url)
    for view in ("v_curve_stats", "v_curve", "v_progress", "v_failures", "v_assessment", "v_trial"):
        execute(url, f"DROP VIEW {view}")
    execute(url, change.format(stored="STORED" if url.startswith("postgres") else "VIRTUAL"))
    with pytest.raises(SchemaVersionError, match=r"is no table, or has other columns\): give"):
        Reader.open(url)


def test_a_table_without_types_is_refused(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/r.db"
    fill(url)
    execute(url, "ALTER TABLE curve RENAME TO other")
    execute(url, "CREATE TABLE curve AS SELECT * FROM other")
    with pytest.raises(SchemaVersionError, match="curve is no table"):
        Reader.open(url)


def test_views_of_a_file_are_not_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    url, mine = f"sqlite:///{tmp_path}/r.db", f"sqlite:///{tmp_path}/mine.db"
    fill(url)
    for view in ("v_progress", "v_trial", "v_failures", "v_assessment"):
        execute(url, f"DROP VIEW {view}")
        execute(url, f"CREATE VIEW {view} AS {ENDLESS}")
    assert main(["status", "--db", url]) == 0
    assert main(["show", "--db", url, "--seed", "1"]) == 0
    assert main(["merge", url, "--db", mine]) == 0
    assert "copied 3 trials (3 done)" in capsys.readouterr().out


def test_the_check_ends(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(url)
    monkeypatch.setattr(schema_version, "CHECK_SECONDS", 0.05)
    monkeypatch.setattr(
        schema_version, "_check_tables", lambda one, _: one.execute(text(ENDLESS)).all()
    )
    with pytest.raises(StoreUnavailableError, match=r"cannot be used.*(interrupt|timeout)"):
        Reader.open(url)


CHANGES = {
    "another seed": "UPDATE trial SET seed = 7 WHERE trial_id = {id}",
    "another key": "UPDATE trial SET trial_key = 'f00' WHERE trial_id = {id}",
    "more states": "UPDATE trajectory SET states_shape = '[9, 4]' WHERE trial_id = {id}",
    "another order": "UPDATE trajectory SET inputs_shape = '[2, 7]' WHERE trial_id = {id}",
    "no shape": "UPDATE trajectory SET states_shape = '[-1, 4]' WHERE trial_id = {id}",
    "no numbers": "UPDATE trajectory SET states_shape = '[\"8\", 4]' WHERE trial_id = {id}",
    "a number": "UPDATE trajectory SET parameters_shape = '[]' WHERE trial_id = {id}",
    "no JSON": "UPDATE trajectory SET parameters_shape = '11' WHERE trial_id = {id}",
    "brackets": "UPDATE trajectory SET parameters_shape = '"
    + 100_000 * "["
    + "' WHERE trial_id = {id}",
    "a matrix": "UPDATE trajectory SET parameters_shape = '[11, 1]' WHERE trial_id = {id}",
    "another type": "UPDATE trajectory SET dtype = '<f4' WHERE trial_id = {id}",
    "a blob too short": "UPDATE trajectory SET inputs = parameters WHERE trial_id = {id}",
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_trial_that_contradicts_itself_stays_out(url: str, other: str, change: str) -> None:
    fill(other)
    ((trial_id, key),) = execute(other, "SELECT trial_id, trial_key FROM trial WHERE seed = 1")
    execute(other, CHANGES[change].format(id=trial_id))
    found = merge(url, other, trial_key)
    assert (found.added, len(found.contradictory)) == ({"done": 2}, 1)
    assert (key,) not in execute(url, "SELECT trial_key FROM trial")


@pytest.mark.parametrize("key", [False, True])
def test_a_configuration_that_is_not_that_of_its_key_stays_out(
    url: str, other: str, key: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(other)
    new = "{}" if key else None
    digest = hashlib.sha256(b"{}").hexdigest()
    where = "WHERE policy = 'random'"
    changed = f"config_json = '{new}', config_key = '{digest}'" if key else "config_json = '{}'"
    execute(other, f"UPDATE config SET {changed} {where}")
    assert main(["merge", other, "--db", url]) == 1
    output = capsys.readouterr().out
    assert "copied 1 trials (1 done)\n2 contradict their keys or the shapes of" in output
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
    fill(sqlite_url)
    execute(sqlite_url, f"UPDATE {change}")
    for words in (["status"], ["show", "--seed", "2"]):
        assert main([*words, "--db", sqlite_url]) == 2
        assert "in the place of JSON: it was changed by hand" in capsys.readouterr().err
    code = main(["merge", sqlite_url, "--db", f"sqlite:///{tmp_path}/mine.db"])
    assert code == (1 if change.startswith("config") else 2)


def test_an_array_that_is_damaged_is_a_sentence(
    sqlite_url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(sqlite_url)
    execute(sqlite_url, "UPDATE trajectory SET states_shape = '[1]'")
    assert main(["export", "trajectories", f"{tmp_path}/x.npz", "--db", sqlite_url]) == 2
    assert "An array of the database is damaged (cannot reshape" in capsys.readouterr().err
