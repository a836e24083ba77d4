"""``retry``: which trials wait again, and what it says of the others."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from orchestrate.store import Reader
from tests.orchestrate.commands.conftest import BAD, BROKEN, DONE, RUNNING, Answer

Run = Callable[..., Answer]
pytestmark = pytest.mark.usefixtures("grid")


def statuses(url: str) -> dict[str, str]:
    with Reader.open(url) as reader:
        return {row[0]: row[1] for row in reader.query("SELECT trial_key, status FROM trial")}


def test_failed_trials_wait_again(command: Run, url: str) -> None:
    before = statuses(url)
    answer = command("retry", "failed")
    assert answer.code == 0
    assert "2 failed trials wait to be run again: the same launch command" in answer.out
    changed = {key for key, status in statuses(url).items() if status != before[key]}
    assert changed == {spec.trial_key for spec in BROKEN}
    assert "There is no failed trial to retry." in command("retry", "failed").out


def test_diverged_trials_lose_what_they_had_written(command: Run, url: str) -> None:
    assert "1 diverged trial waits" in command("retry", "diverged").out
    assert statuses(url)[BAD.trial_key] == "pending"
    with Reader.open(url) as reader:
        assert len(reader.trials(BAD.config_key)) == 3
        assert reader.curves(BAD.config_key).values.shape[0] == 0


def test_all_of_them(command: Run, url: str) -> None:
    document = command("retry", "all", "--json").document
    assert document["trials"] == 3
    assert set(document["keys"]) == {spec.trial_key for spec in (*BROKEN, BAD)}
    assert document["left"] == {"done": 3, "running": 1, "pending": 2}
    assert "failed" not in statuses(url).values()


def test_a_dry_run_changes_nothing(command: Run, url: str) -> None:
    before = statuses(url)
    answer = command("retry", "all", "--dry-run")
    assert "3 unsuccessful trials would wait to be run again; nothing was changed." in answer.out
    assert command("retry", "all", "--dry-run", "--json").document["dry_run"] is True
    assert statuses(url) == before


def test_filters_narrow_it(command: Run, url: str) -> None:
    assert "no failed trial" in command("retry", "failed", "--env", "cartpole").out
    answer = command("retry", "failed", "--trial", BROKEN[0].trial_key[:10])
    assert "1 failed trial waits" in answer.out
    assert statuses(url)[BROKEN[0].trial_key] == "pending"
    assert statuses(url)[BROKEN[1].trial_key] == "failed"


def test_it_says_what_is_left_as_it_is(command: Run, url: str) -> None:
    named = [spec.trial_key for spec in (DONE[0], RUNNING)]
    answer = command("retry", "failed", "--trial", *named)
    assert answer.out == (
        "There is no failed trial to retry. Left as they are: 1 done, 1 running.\n"
    )
    assert statuses(url)[RUNNING.trial_key] == "running"


@pytest.mark.parametrize("key", ["0000000000000000", "xyz", "ab"])
def test_a_key_that_names_no_trial_is_refused(command: Run, url: str, key: str) -> None:
    before = statuses(url)
    answer = command("retry", "all", "--trial", BROKEN[0].trial_key, key)
    assert answer.code == 2
    assert key in answer.err
    assert statuses(url) == before
