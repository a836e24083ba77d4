"""What an output says of its origin."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from analysis.data import provenance


def test_the_commit_is_that_of_the_code_and_not_of_a_folder_around_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as the repository that holds the virtual environment of an installed copy."""
    package = tmp_path / "venv" / "analysis"
    package.mkdir(parents=True)
    git = ("git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b")
    subprocess.run([*git, "init", "--quiet"], check=True)
    subprocess.run([*git, "commit", "--quiet", "--allow-empty", "--message", "x"], check=True)
    monkeypatch.setattr(provenance, "PACKAGE", package)
    state = provenance.git_state.__wrapped__
    monkeypatch.delenv("DOPT_COMMIT", raising=False)
    assert state() == {"commit": None, "dirty": None}
    monkeypatch.setenv("DOPT_COMMIT", "abc")
    assert state() == {"commit": "abc", "dirty": None}
    monkeypatch.setattr(provenance, "PACKAGE", tmp_path / "analysis")
    (tmp_path / "analysis").mkdir()
    found = state()
    assert re.fullmatch(r"[0-9a-f]{40}", str(found["commit"]))
    assert found["dirty"] is False
