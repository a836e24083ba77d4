"""The progress that a launch shows, and the provenance that it records."""

from __future__ import annotations

import io
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from orchestrate import fingerprint
from orchestrate.runner.progress import Progress, Tally, duration
from orchestrate.runner.saving import launch_record
from tests.paths import ROOT


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Return a function that lets time pass."""
    now = [0.0]
    monkeypatch.setattr("orchestrate.runner.progress.time.monotonic", lambda: now[0])

    def passes(seconds: float) -> None:
        now[0] += seconds

    return passes


def test_the_line_has_the_outcomes_the_rate_and_the_time_left(
    clock: Callable[[float], None],
) -> None:
    tally = Tally(total=2000, before=500, failed_before=3)
    shown = Progress(tally, io.StringIO())
    tally.done, tally.diverged, tally.failed = 145, 4, 1
    clock(10.0)
    shown.update()
    assert shown.line() == (
        "650 of 2,000 · 145 done now · 4 failed · 4 diverged · 15.0/s · 1 min 30 s left"
    )


def test_the_time_left_is_not_estimated_before_a_tenth_of_the_trials(
    clock: Callable[[float], None],
) -> None:
    """A grid of 100 s said "1 h 46 min left": its first trials waited for the workers to start."""
    tally = Tally(total=600, before=100)
    shown = Progress(tally, None)
    tally.done = 49
    clock(30.0)
    shown.update()
    assert "left" not in shown.line()
    tally.done = 50
    assert shown.line().endswith("4 min 36 s left")


def test_the_rate_is_that_of_the_last_half_minute(clock: Callable[[float], None]) -> None:
    tally = Tally(total=1000)
    shown = Progress(tally, None)
    for _ in range(60):
        clock(1.0)
        shown.update()
    for _ in range(60):
        tally.done += 2
        clock(1.0)
        shown.update()
    assert "2.0/s" in shown.line()


def test_a_file_gets_a_line_now_and_then_and_one_at_the_end(clock: Callable[[float], None]) -> None:
    stream = io.StringIO()
    tally = Tally(total=100)
    with Progress(tally, stream) as shown:
        for _ in range(45):
            tally.done += 1
            clock(0.5)
            shown.update()
    lines = stream.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[-1].startswith("45 of 100")
    assert "\x1b" not in stream.getvalue()


def test_a_terminal_gets_one_line_in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: True)
    tally = Tally(total=10)
    with Progress(tally, stream) as shown:
        tally.done = 10
        shown.update()
    assert "10 of 10" in stream.getvalue()
    assert "\x1b[" in stream.getvalue()


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.2, "0 s"), (59, "59 s"), (125, "2 min 05 s"), (7260, "2 h 01 min")]
)
def test_durations_are_for_people(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=n", "-c", "user.email=e@example.org"]
    done = subprocess.run(
        ["git", "-C", str(folder), *identity, *arguments], check=True, capture_output=True
    )
    return done.stdout.decode().strip()


def commit(folder: Path, name: str) -> None:
    """Make a repository of the folder, with one file."""
    git(folder, "init")
    (folder / name).write_text("a = 1\n")
    git(folder, "add", ".")
    git(folder, "commit", "-m", "Add a file")


def test_outside_a_repository_there_is_no_commit_but_that_of_the_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = launch_record(["launch.py"], ["seed=1"], tmp_path)
    assert (record.git_commit, record.git_dirty, record.git_diff_hash) == (None, None, None)
    assert record.overrides == ["seed=1"]
    assert {"python", "numpy", "numba", "hydra-core"} <= set(record.versions)
    assert {"llvmlite", "cpu", "cpu_model", "cpu_features", "platform"} <= set(record.versions)
    assert all(record.versions.values())
    monkeypatch.setenv("DOPT_COMMIT", "c" * 40)
    record = launch_record([], [], tmp_path)
    assert (record.git_commit, record.git_dirty) == ("c" * 40, None)


def test_the_commit_and_what_differs_from_it(tmp_path: Path) -> None:
    commit(tmp_path, "code.py")
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
    commit(tmp_path, "note")
    installed = tmp_path / "site-packages"
    installed.mkdir()
    assert launch_record([], [], installed).git_commit is None


def test_untracked_results_and_builds_leave_the_code_clean(tmp_path: Path) -> None:
    commit(tmp_path, "code.py")
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
