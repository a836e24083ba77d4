"""The variable DOPT_DB, which names the database of a launch."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrate.store import default_url
from tests.orchestrate.test_command_line import SHORT, Command

FROM_VARIABLE = "The database URL in the environment variable DOPT_DB cannot be read"


def test_the_database_of_the_environment(
    command_line: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("DOPT_DB", f"sqlite:///{tmp_path}/mine.db")
    assert command_line(*SHORT)[0] == 0
    assert (tmp_path / "mine.db").exists()


def test_a_path_in_the_variable_is_answered_with_the_variable_and_the_url(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOPT_DB", "mine/x.db")
    code, _, errors = command_line(*SHORT)
    assert code == 2
    assert f"{FROM_VARIABLE}: write it as sqlite:///mine/x.db." in errors
    monkeypatch.setenv("DOPT_DB", "me:secret@host/x.db")
    _, _, errors = command_line(*SHORT)
    assert f"{FROM_VARIABLE}: write it as sqlite:///results/results.db or " in errors
    assert "secret" not in errors
    _, _, errors = command_line(*SHORT, "store.url=mine/x.db")
    assert "The database URL cannot be read: write it as sqlite:///mine/x.db." in errors


def test_an_empty_variable_counts_as_unset(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOPT_DB", "")
    code, output, errors = command_line(*SHORT)
    assert (code, errors) == (0, "")
    assert "sqlite:///results/results.db" in output
    assert default_url() == "sqlite:///results/results.db"
