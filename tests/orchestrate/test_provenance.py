"""What is written down about a command."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from orchestrate.provenance import launch_record, without_password


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=n", "-c", "user.email=e@example.org"]
    done = subprocess.run(
        ["git", "-C", str(folder), *identity, *arguments], check=True, capture_output=True
    )
    return done.stdout.decode().strip()


def test_outside_a_repository_there_is_no_commit(tmp_path: Path) -> None:
    record = launch_record(["launch.py"], ["seed=1"], tmp_path)
    assert (record.git_commit, record.git_dirty, record.git_diff_hash) == (None, None, None)
    assert record.overrides == ["seed=1"]
    assert {"python", "numpy", "numba", "hydra-core"} <= set(record.versions)


def test_the_commit_and_what_differs_from_it(tmp_path: Path) -> None:
    git(tmp_path, "init")
    (tmp_path / "code.py").write_text("a = 1\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "Add code")
    clean = launch_record([], [], tmp_path)
    assert (clean.git_commit, clean.git_dirty) == (git(tmp_path, "rev-parse", "HEAD"), False)
    assert clean.git_diff_hash is None
    (tmp_path / "code.py").write_text("a = 2\n")
    dirty = launch_record([], [], tmp_path)
    assert (dirty.git_commit, dirty.git_dirty) == (clean.git_commit, True)
    assert dirty.git_diff_hash is not None


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("store.url=postgresql://me:pa:ss@host:5432/db", "store.url=postgresql://me:***@host:5432/db"),
        ("postgresql+psycopg://:pw@host/db", "postgresql+psycopg://:***@host/db"),
        ("sqlite:///results/results.db", "sqlite:///results/results.db"),
        ("ray://host:10001", "ray://host:10001"),
    ],
)  # fmt: skip
def test_passwords_are_hidden(text: str, safe: str) -> None:
    assert without_password(text) == safe
