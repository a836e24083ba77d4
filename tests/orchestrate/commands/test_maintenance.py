"""``upgrade``, ``merge`` and ``doctor``: what they print, and their exit codes."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from orchestrate.store import Reader, Store
from orchestrate.store.records import utc_text
from orchestrate.store.schema import SCHEMA_VERSION
from tests.orchestrate.commands.conftest import BAD, BROKEN, DONE, RUNNING, WAITING, Answer, on_both
from tests.orchestrate.store.databases import execute, file_of, restored
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, begin, everything, result, run_all
from tests.orchestrate.store.released import restore

Run = Callable[..., Answer]


def run_trials(url: str, *seeds: int, offset: int = 0) -> None:
    run_all(url, *map(Spec, seeds), make=lambda one: result(one.seed + offset))


@pytest.fixture
def other(tmp_path: Path) -> Path:
    return tmp_path / "other.db"


class TestUpgrade:
    @pytest.fixture
    def url(self, sqlite_url: str) -> str:
        return sqlite_url

    def test_of_an_older_database(self, command: Run, url: str) -> None:
        restore(5, url)
        refused = command("status")
        assert refused.code == 2
        assert f"run 'python -m orchestrate upgrade --db {url}'" in refused.err
        answer = command("upgrade")
        assert answer.code == 0
        backup = f"a backup is in the file {file_of(url)}.v5-b"
        assert f"went from schema 5 to {SCHEMA_VERSION}; {backup}" in answer.out
        assert command("status").code == 0
        assert "there is nothing to do" in command("upgrade").out

    def test_without_a_backup(self, command: Run, url: str) -> None:
        restore(5, url)
        document = command("upgrade", "--no-backup", "--json").document
        assert document == {
            "safe_url": url, "before": 5, "after": SCHEMA_VERSION, "backup": None, "packed": 0,
            "changed": True,
        }  # fmt: skip
        assert not list(file_of(url).parent.glob("*backup*"))


class TestMerge:
    @on_both
    def test_names_what_it_brought(self, command: Run, url: str, other: Path) -> None:
        run_trials(url, 0, 1)
        run_trials(f"sqlite:///{other}", 1, 2, 3)
        answer = command("merge", str(other))
        assert answer.code == 0
        assert "copied 2 trials (2 done)" in answer.out
        assert "1 exist here with equal numbers" in answer.out
        document = command("merge", f"sqlite:///{other}", "--json").document
        assert (document["identical"], document["changed"]) == (3, False)

    def test_names_conflicts(self, command: Run, url: str, other: Path) -> None:
        run_trials(url, *range(12))
        run_trials(f"sqlite:///{other}", *range(12), offset=50)
        answer = command("merge", str(other))
        assert answer.code == 1
        assert "12 have different numbers here and were not copied:" in answer.out
        assert "pendulum random seed 3" in answer.out
        assert "and 2 more" in answer.out
        assert len(command("merge", str(other), "--json").document["conflicts"]) == 12


class TestDoctor:
    def test_finds_nothing_in_what_a_launch_wrote(self, command: Run, url: str) -> None:
        restore(5, url)
        command("upgrade", "--no-backup")
        answer = command("doctor")
        assert answer.code == 0
        assert "2 notes" in answer.out
        assert "error" not in answer.out

    @on_both
    def test_names_what_is_wrong(self, command: Run, url: str) -> None:
        restore(5, url)
        command("upgrade", "--no-backup")
        execute(url, "DELETE FROM step WHERE trial_id = 1 AND t = 7")
        answer = command("doctor")
        assert answer.code == 1
        first = "error: finished trials without one step for each t below their horizon: 1"
        assert answer.out.startswith(first)
        document = command("doctor", "--json").document
        assert [one["severity"] for one in document][:2] == ["error", "error"]
        assert all(one["advice"] for one in document)


TABLES = ("trial", "step", "curve", "trajectory", "attempt", "config", "error")


def counts(url: str) -> dict[str, object]:
    return {name: execute(url, f"SELECT count(*) FROM {name}")[0][0] for name in TABLES}


def short(*words: Any, connect: Any = sqlite3.connect, **options: Any) -> sqlite3.Connection:
    """Open a SQLite database that has no room for a third page."""
    opened: sqlite3.Connection = connect(*words, **options)
    if not options:  # the copy
        opened.execute("PRAGMA max_page_count = 2")
    return opened


@pytest.fixture
def ended(grid: int, store: Store) -> int:
    """Return the launch of the grid, which has ended."""
    store.end_launch(grid, "done")
    return grid


@on_both
@pytest.mark.usefixtures("grid")
class TestBackup:
    def test_while_a_launch_writes(
        self, grid: int, command: Run, store: Store, url: str, tmp_path: Path
    ) -> None:
        before = everything(url)
        copy = tmp_path / "new" / "copy"
        answer = command("backup", str(copy))
        assert answer.code == 0
        assert answer.out == f"{copy}: {copy.stat().st_size:,} bytes\n"
        store.end_launch(grid, "done")
        assert everything(restored(copy, url)) == before
        assert [path.name for path in copy.parent.iterdir()] == ["copy"]

    def test_a_full_disk_names_the_copy_and_not_the_database(
        self, command: Run, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        if url.startswith("sqlite"):
            monkeypatch.setattr("orchestrate.store.backend.sqlite3.connect", short)
        else:
            said = "pg_dump: error: could not write to file: No space left on device"
            program = tmp_path / "bin" / "pg_dump"
            program.parent.mkdir()
            program.write_text(f"#!/bin/sh\necho {said!r} >&2\nexit 1\n")
            program.chmod(0o755)
            monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
        copy = tmp_path / "new" / "copy"
        answer = command("backup", str(copy))
        assert answer.code == 2
        assert f"error: {copy} cannot be written (" in answer.err
        assert "No space left on device" in answer.err
        assert "results database" not in answer.err
        assert list(copy.parent.iterdir()) == []

    def test_no_file_is_replaced(self, command: Run, tmp_path: Path) -> None:
        copy = tmp_path / "copy"
        copy.write_text("mine")
        answer = command("backup", str(copy))
        assert answer.code == 2
        assert "exists, a new one is expected" in answer.err
        assert copy.read_text() == "mine"


@pytest.mark.usefixtures("grid")
def test_what_a_running_launch_has_stays(command: Run, store: Store, url: str) -> None:
    """The deletion itself looks which launches live, as one may have begun since."""
    before = everything(url)
    for how in ("--dry-run", "--yes"):
        answer = command("prune", "--env", "pendulum", how)
        assert answer.out.startswith("There is no trial to delete. 6 more stay")
    assert store.prune([one.trial_key for one in (*DONE, RUNNING, *WAITING)]) == 0
    assert everything(url) == before


@pytest.mark.usefixtures("ended")
class TestPrune:
    def test_a_dry_run_changes_nothing(self, command: Run, url: str) -> None:
        before = everything(url)
        answer = command("prune", "--policy", "random", "--dry-run")
        assert answer.code == 0
        assert answer.out.startswith("3 trials would be deleted (3 done): 21 steps, about ")
        assert "3 more stay" in answer.out
        assert everything(url) == before

    @on_both
    def test_by_query(self, command: Run, url: str) -> None:
        before = counts(url)
        sql = "SELECT trial_key FROM v_trial WHERE status IN ('diverged', 'failed')"
        document = command("prune", sql, "--yes", "--json").document
        assert (document["deleted"], document["steps"]) == (3, 7)
        assert document["statuses"] == {"diverged": 1, "failed": 2}
        assert counts(url) == {
            "trial": before["trial"] - 3,
            "step": 21,
            "curve": 3,
            "trajectory": 3,
            "attempt": before["attempt"] - 3,
            "config": before["config"] - 1,  # all of d_optimal
            "error": 0,
        }

    def test_by_age(self, store: Store, command: Run, url: str) -> None:
        moment = utc_text(datetime.now(UTC) - timedelta(days=100))
        launch, (claim,) = begin(store, Spec(99))
        store.commit(claim, result(99), RUN)
        execute(url, f"UPDATE attempt SET ended = '{moment}' WHERE trial_id = {claim.trial_id}")
        store.end_launch(launch, "done")
        document = command("prune", "--older-than", "90d", "--yes", "--json").document
        assert document["keys"] == [Spec(99).trial_key]
        assert {key for (key,) in execute(url, "SELECT trial_key FROM trial")} == {
            one.trial_key for one in (*DONE, BAD, RUNNING, *WAITING)
        } | {key for (key,) in execute(url, "SELECT trial_key FROM trial WHERE status = 'failed'")}

    def test_deleted_trials_run_again(self, store: Store, command: Run) -> None:
        command("prune", "--policy", "random", "--env", "pendulum", "--yes")
        launch = store.begin_launch(LAUNCH)
        assert len(store.register(launch, DONE).todo) == len(DONE)

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["--dry-run"], "prune has no rule"),
            (["--env", "pendulum"], "one of the arguments --dry-run --yes is required"),
            (["SELECT seed FROM trial", "--yes"], "columns seed, trial_key is expected"),
            (["DELETE FROM trial", "--yes"], "failed"),
            (["--older-than", "soon", "--yes"], "a time such as"),
            (["--older-than", "99999999999d", "--yes"], "at most a hundred years"),
        ],
    )
    def test_a_wrong_rule_is_refused(
        self, command: Run, url: str, words: list[str], message: str
    ) -> None:
        before = everything(url)
        answer = command("prune", *words)
        assert answer.code == 2
        assert message in answer.err
        assert everything(url) == before


def statuses(url: str) -> dict[str, str]:
    with Reader.open(url) as reader:
        return {row[0]: row[1] for row in reader.rows("SELECT trial_key, status FROM trial")}


@on_both
def test_failed_trials_wait_again(ask: Run, url: str) -> None:
    before = statuses(url)
    answer = ask("retry", "failed")
    assert answer.code == 0
    assert "2 failed trials wait to be run again: the same launch command" in answer.out
    changed = {key for key, status in statuses(url).items() if status != before[key]}
    assert changed == {spec.trial_key for spec in BROKEN}
    assert "There is no failed trial to retry." in ask("retry", "failed").out


def test_all_of_them(ask: Run, url: str) -> None:
    document = ask("retry", "all", "--json").document
    assert document["trials"] == 3
    assert set(document["keys"]) == {spec.trial_key for spec in (*BROKEN, BAD)}
    assert document["left"] == {"done": 3, "running": 1, "pending": 2}
    assert "failed" not in statuses(url).values()


def test_a_dry_run_changes_nothing(ask: Run, url: str) -> None:
    before = statuses(url)
    answer = ask("retry", "all", "--dry-run")
    assert "3 unsuccessful trials would wait to be run again; nothing was changed." in answer.out
    assert ask("retry", "all", "--dry-run", "--json").document["dry_run"] is True
    assert statuses(url) == before


def test_filters_narrow_it(ask: Run, url: str) -> None:
    assert "no failed trial" in ask("retry", "failed", "--env", "cartpole").out
    answer = ask("retry", "failed", "--trial", BROKEN[0].trial_key[:10])
    assert "1 failed trial waits" in answer.out
    assert statuses(url)[BROKEN[0].trial_key] == "pending"
    assert statuses(url)[BROKEN[1].trial_key] == "failed"


def test_it_says_what_is_left_as_it_is(ask: Run, url: str) -> None:
    named = [spec.trial_key for spec in (DONE[0], RUNNING)]
    answer = ask("retry", "failed", "--trial", *named)
    assert answer.out == (
        "There is no failed trial to retry. Left as they are: 1 done, 1 running.\n"
    )
    assert statuses(url)[RUNNING.trial_key] == "running"


@pytest.mark.parametrize("key", ["0000000000000000", "xyz", "ab"])
def test_a_key_that_names_no_trial_is_refused(ask: Run, url: str, key: str) -> None:
    before = statuses(url)
    answer = ask("retry", "all", "--trial", BROKEN[0].trial_key, key)
    assert answer.code == 2
    assert key in answer.err
    assert statuses(url) == before
