"""Provenance of a command in the database."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from orchestrate import fingerprint
from orchestrate.runner.saving import launch_record
from tests.paths import ROOT


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


def test_an_image_without_its_repository_says_the_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOPT_COMMIT", "c" * 40)
    record = launch_record([], [], tmp_path)
    assert (record.git_commit, record.git_dirty) == ("c" * 40, None)


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
    (tmp_path / "code.py").write_text("a = 1\n")
    (tmp_path / "new.py").write_text("b = 1\n")
    added = launch_record([], [], tmp_path)
    (tmp_path / "new.py").write_text("b = 2\n")
    changed = launch_record([], [], tmp_path)
    hashes = {one.git_diff_hash for one in (clean, dirty, added, changed)}
    assert len(hashes) == 4
    assert added.git_dirty


def test_a_repository_around_an_installed_copy_is_not_that_of_the_code(tmp_path: Path) -> None:
    git(tmp_path, "init")
    (tmp_path / "note").write_text("mine\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "Add a note")
    installed = tmp_path / "site-packages"
    installed.mkdir()
    assert launch_record([], [], installed).git_commit is None


def test_the_processor_and_what_compiles_for_it_are_named(tmp_path: Path) -> None:
    versions = launch_record([], [], tmp_path).versions
    assert {"llvmlite", "cpu", "cpu_model", "cpu_features", "platform"} <= set(versions)
    assert all(versions.values())


def test_untracked_results_and_builds_leave_the_code_clean(tmp_path: Path) -> None:
    git(tmp_path, "init")
    (tmp_path / "code.py").write_text("a = 1\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "Add code")
    for name in ("exported/curves.csv", "build/lib/code.py", "dist/dopt.whl", "notes.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("output\n")
    record = launch_record([], [], tmp_path)
    assert (record.git_dirty, record.git_diff_hash) == (False, None)
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "boat.yaml").write_text("mass: 1\n")
    assert launch_record([], [], tmp_path).git_dirty


def test_the_fingerprint_is_that_of_the_sources_and_libraries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = launch_record([], [], tmp_path).fingerprint
    assert before is not None
    assert before == fingerprint.fingerprint()
    assert fingerprint.differences(before, before) == ""
    shutil.copytree(ROOT / "dopt", tmp_path / "dopt", ignore=shutil.ignore_patterns("__pycache__"))
    found = fingerprint.importlib.util.find_spec

    def find(name: str) -> object:
        if name == "dopt":
            return SimpleNamespace(submodule_search_locations=[str(tmp_path / "dopt")])
        return found(name)

    monkeypatch.setattr(fingerprint.importlib.util, "find_spec", find)
    assert fingerprint.fingerprint() == before, "the same sources in another folder"
    with (tmp_path / "dopt" / "errors.py").open("a") as source:
        source.write("# one more line\n")
    after = fingerprint.fingerprint()
    assert {name for name in after if after[name] != before[name]} == {"code of dopt"}
    said = fingerprint.differences(before, after)
    assert said == (
        f"the code of dopt is {before['code of dopt']} there and {after['code of dopt']} here"
    )
