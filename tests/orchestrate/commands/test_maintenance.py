"""``upgrade``, ``merge`` and ``doctor``: what they print, and their exit codes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import create_engine
from sqlalchemy.engine import make_url

from orchestrate.commands.maintenance import trial_key
from orchestrate.store import Reader, Store
from orchestrate.store.merge import merge
from orchestrate.store.schema import SCHEMA_VERSION
from tests.orchestrate.commands.conftest import Answer
from tests.orchestrate.standins import specification
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result
from tests.orchestrate.store.migrations.released import restore

Run = Callable[..., Answer]


def run_trials(url: str, *seeds: int, offset: int = 0) -> None:
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        specs = [Spec(seed) for seed in seeds]
        for claim, spec in zip(
            store.claim(launch, store.register(launch, specs).todo), specs, strict=True
        ):
            store.commit(claim, result(spec.seed + offset), RUN)
        store.end_launch(launch, "done")


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
        backup = f"a backup is in the file {_path(url)}.v5-b"
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
        assert not list(_path(url).parent.glob("*backup*"))

    def test_of_nothing(self, command: Run) -> None:
        answer = command("upgrade")
        assert answer.code == 2
        assert "There is no results database" in answer.err

    def test_of_an_empty_file(self, command: Run, url: str) -> None:
        _path(url).parent.mkdir()
        _path(url).touch()
        assert f"was empty and has schema {SCHEMA_VERSION} now" in command("upgrade").out


def _path(url: str) -> Path:
    return Path(str(make_url(url).database))


class TestMerge:
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

    def test_of_nothing(self, command: Run, other: Path) -> None:
        answer = command("merge", str(other))
        assert answer.code == 2
        assert "There is no results database" in answer.err


class TestDoctor:
    def test_finds_nothing_in_what_a_launch_wrote(self, command: Run, url: str) -> None:
        restore(5, url)
        command("upgrade", "--no-backup")
        answer = command("doctor")
        assert answer.code == 0
        assert "2 notes" in answer.out
        assert "error" not in answer.out

    def test_names_what_is_wrong(self, command: Run, url: str) -> None:
        restore(5, url)
        command("upgrade", "--no-backup")
        engine = create_engine(url)
        with engine.begin() as connection:
            connection.exec_driver_sql("DELETE FROM step WHERE trial_id = 1 AND t = 7")
        engine.dispose()
        answer = command("doctor")
        assert answer.code == 1
        first = "error: finished trials without one step for each t below their horizon: 1"
        assert answer.out.startswith(first)
        document = command("doctor", "--json").document
        assert [one["severity"] for one in document][:2] == ["error", "error"]
        assert all(one["advice"] for one in document)

    def test_what_it_advises_helps(self, command: Run, url: str, tmp_path: Path) -> None:
        restore(5, url)
        command("upgrade", "--no-backup")
        engine = create_engine(url)
        with engine.begin() as connection:
            connection.exec_driver_sql("DELETE FROM trajectory WHERE trial_id = 1")
        engine.dispose()
        new = f"sqlite:///{tmp_path}/new.db"
        assert len(merge(new, url).incomplete) == 1
        with Reader.open(new) as reader:
            assert sum(config.n_done for config in reader.configs()) == 3

    def test_knows_the_key_of_a_trial(self) -> None:
        trial = specification(seed=12345678901)
        assert trial_key(trial.config_json, trial.seed) == trial.trial_key
