"""``backup``, ``prune`` and ``vacuum``: copies, deletion by rule, space that is given back."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from orchestrate.store import Store
from orchestrate.store.maintenance import back_up
from orchestrate.store.records import utc_text
from tests.orchestrate.commands.conftest import BAD, DONE, RUNNING, WAITING, Answer
from tests.orchestrate.store.everything import everything
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result
from tests.orchestrate.store.places import execute, restored

Run = Callable[..., Answer]

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
        self, grid: int, command: Run, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        if url.startswith("sqlite"):
            monkeypatch.setattr("orchestrate.store.backends.backups.sqlite3.connect", short)
        else:
            said = "pg_dump: error: could not write to file: No space left on device"
            program = tmp_path / "bin" / "pg_dump"
            program.parent.mkdir()
            program.write_text(f"#!/bin/sh\necho {said!r} >&2\nexit 1\n")
            program.chmod(0o755)
            monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
        copy = tmp_path / "new" / "copy"
        answer = command("backup", str(copy))
        assert grid
        assert answer.code == 2
        assert f"error: {copy} cannot be written (" in answer.err
        assert "No space left on device" in answer.err
        assert "results database" not in answer.err
        assert list(copy.parent.iterdir()) == []

    def test_no_file_is_replaced(self, grid: int, command: Run, tmp_path: Path) -> None:
        copy = tmp_path / "copy"
        copy.write_text("mine")
        answer = command("backup", str(copy))
        assert grid
        assert answer.code == 2
        assert "exists, a new one is expected" in answer.err
        assert copy.read_text() == "mine"

    def test_without_the_program_of_the_server(
        self, postgresql_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        Store.open(postgresql_url).close()
        monkeypatch.setenv("PATH", str(tmp_path))
        with pytest.raises(Exception, match="pg_dump, which is not installed"):
            back_up(postgresql_url, tmp_path / "copy")


class TestPrune:
    def test_a_dry_run_changes_nothing(self, ended: int, command: Run, url: str) -> None:
        before = everything(url)
        answer = command("prune", "--policy", "random", "--dry-run")
        assert ended
        assert answer.code == 0
        assert answer.out.startswith("3 trials would be deleted (3 done): 21 steps, about ")
        assert "3 more stay" in answer.out
        assert everything(url) == before

    def test_by_query(self, ended: int, command: Run, url: str) -> None:
        before = counts(url)
        sql = "SELECT trial_key FROM v_trial WHERE status IN ('diverged', 'failed')"
        document = command("prune", sql, "--yes", "--json").document
        assert ended
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

    def test_by_age(self, ended: int, store: Store, command: Run, url: str) -> None:
        moment = utc_text(datetime.now(UTC) - timedelta(days=100))
        launch = store.begin_launch(LAUNCH)
        (claim,) = store.claim(launch, store.register(launch, [Spec(99)]).todo)
        store.commit(claim, result(99), RUN)
        execute(url, f"UPDATE attempt SET ended = '{moment}' WHERE trial_id = {claim.trial_id}")
        store.end_launch(launch, "done")
        document = command("prune", "--older-than", "90d", "--yes", "--json").document
        assert ended
        assert document["keys"] == [Spec(99).trial_key]
        assert {key for (key,) in execute(url, "SELECT trial_key FROM trial")} == {
            one.trial_key for one in (*DONE, BAD, RUNNING, *WAITING)
        } | {key for (key,) in execute(url, "SELECT trial_key FROM trial WHERE status = 'failed'")}

    def test_what_a_running_launch_has_stays(self, grid: int, command: Run, url: str) -> None:
        before = everything(url)
        for how in ("--dry-run", "--yes"):
            answer = command("prune", "--env", "pendulum", how)
            assert answer.out.startswith("There is no trial to delete. 6 more stay")
        assert grid
        assert everything(url) == before

    def test_a_launch_that_began_since_keeps_its_trials(
        self, grid: int, store: Store, url: str
    ) -> None:
        """The deletion itself looks which launches live."""
        before = everything(url)
        assert grid
        assert store.prune([one.trial_key for one in (*DONE, RUNNING, *WAITING)]) == 0
        assert everything(url) == before

    def test_deleted_trials_run_again(self, ended: int, store: Store, command: Run) -> None:
        command("prune", "--policy", "random", "--env", "pendulum", "--yes")
        launch = store.begin_launch(LAUNCH)
        assert ended
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
        self, ended: int, command: Run, url: str, words: list[str], message: str
    ) -> None:
        before = everything(url)
        answer = command("prune", *words)
        assert ended
        assert answer.code == 2
        assert message in answer.err
        assert everything(url) == before


class TestVacuum:
    def test_gives_space_back(self, ended: int, command: Run, url: str) -> None:
        kept = everything(url)
        text = 200_000 * "x"
        execute(
            url, f"INSERT INTO error (hash, type, message, traceback) VALUES ('', '', '', '{text}')"
        )
        execute(url, "DELETE FROM error WHERE hash = ''")
        answer = command("vacuum", "--json")
        assert answer.code == 0, answer.err
        document = answer.document
        assert ended
        if url.startswith("sqlite"):
            assert document["after"] < document["before"] - len(text) / 2
        assert document["after"] > 0
        assert everything(url) == kept

    def test_waits_for_no_launch(self, grid: int, command: Run, url: str) -> None:
        answer = command("vacuum")
        if url.startswith("sqlite"):
            assert answer.code == 2
            assert f"Launch {grid} " in answer.err
            assert "is running" in answer.err
        else:
            assert answer.code == 0
            assert "bytes before" in answer.out


class TestWithoutADatabase:
    @pytest.fixture
    def url(self, sqlite_url: str) -> str:
        return sqlite_url

    @pytest.mark.parametrize("words", [["backup", "copy"], ["prune", "--yes"], ["vacuum"]])
    def test_there_is_none_afterwards(self, command: Run, url: str, words: list[str]) -> None:
        rule = ["--older-than", "1d"] if words[0] == "prune" else []
        answer = command(*words, *rule)
        assert answer.code == 2
        assert "There is no results database" in answer.err
        assert not Path(url.removeprefix("sqlite:///")).exists()
        assert not Path("copy").exists()
