"""Frame of every program: streams, signals, warnings, versions, and the exit code of an error."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import dopt
from dopt.errors import DoptError
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate import program
from orchestrate.errors import (
    ExitCode,
    InfrastructureError,
    OutputError,
    make_folder,
    whole,
    without_password,
    without_password_in_word,
    writing,
)
from orchestrate.program import as_started
from orchestrate.runner.saving import launch_record
from orchestrate.store import StoreUnavailableError
from tests.orchestrate.conftest import Launches
from tests.orchestrate.framed import LETTERS
from tests.paths import ROOT, loaded_by, without_coverage

PROGRAMS = (["orchestrate/launch.py"], ["-m", "orchestrate"], ["-m", "analysis"])
WORDS = {"orchestrate/launch.py": "env=pendulum", "orchestrate": "status", "analysis": "summary"}

Capture = pytest.CaptureFixture[str]


def started(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the program of the tests."""
    return subprocess.run(
        [sys.executable, "-m", "tests.orchestrate.framed", *words],
        cwd=ROOT, env={**without_coverage(), **environment},
        capture_output=True, encoding="latin-1", check=False,
    )  # fmt: skip


# Which exception becomes which exit code


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (DoptError("width is wide."), 2, "error: width is wide."),
        (InfrastructureError("Ray is gone."), 75, "error: Ray is gone."),
        (StoreUnavailableError("The disk is full."), 75, "error: The disk is full."),
        (BlockingIOError(errno.EAGAIN, "Try again"), 75, "no further process.*Try again.*pids.max"),
        (OSError(errno.EMFILE, "Too many open files"), 75, "Too many open files"),
        (RuntimeError("can't start new thread"), 75, "no further process.*can't start new thread"),
        (MemoryError(), 75, "MemoryError"),
        (FileNotFoundError(errno.ENOENT, "No such file", "a/b"), 2, "a/b cannot be used"),
        (OSError(errno.ENOSPC, "No space left"), 2, r"The output, .* \(No space left\)"),
        (ModuleNotFoundError("No module named 'numba'"), 2, "No module named 'numba': install"),
        (UnicodeDecodeError("utf-8", b"\xee", 0, 1, "invalid"), 2, "no text in UTF-8"),
    ],
)
def test_what_a_user_meets_is_one_sentence_without_a_traceback(
    error: Exception, code: int, words: str, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program, "discard_output", lambda: None)
    assert program.answered(raising(error))() == code == program.exit_code(error)
    said = capsys.readouterr().err
    assert re.fullmatch("error: [^\n]+\n", said), said
    assert re.search(words, said), said


def raising(error: BaseException) -> Callable[[], int]:
    def main() -> int:
        raise error

    return main


def test_a_defect_has_a_traceback_and_70(capsys: Capture) -> None:
    assert program.answered(raising(KeyError("x")))() == ExitCode.DEFECT
    assert "Traceback" in capsys.readouterr().err
    assert program.answered(raising(KeyboardInterrupt()))() == ExitCode.INTERRUPTED
    assert capsys.readouterr().err == ""


def test_the_traceback_of_a_sentence_is_shown_on_request(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    assert program.answered(raising(DoptError("no")))() == 2
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert said.endswith("error: no\n")


@pytest.mark.parametrize("place", ["queue.py", "queue/__init__.py"])
def test_a_module_that_hides_one_of_the_standard_library_is_named(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    (tmp_path / "queue").mkdir()
    (tmp_path / place).write_text("")
    (tmp_path / "json.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    error = AttributeError("module 'queue' has no attribute 'SimpleQueue'")
    assert program.answered(raising(error))() == ExitCode.BAD_REQUEST
    assert f"{tmp_path}/{place} hides the module queue" in capsys.readouterr().err
    assert program.hiding("AttributeError: module 'csv' has no attribute 'x'") == ""


# Streams and signals


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_closed_stream_is_no_place_for_a_file(closed: str, tmp_path: Path) -> None:
    """Cron and daemons start programs without streams."""
    out = tmp_path / "out"
    command = f"{sys.executable} -m tests.orchestrate.framed"
    for words, expected in ((f"open {out}", 5), ("child", 5), ("letters", 5)):
        done = subprocess.run(
            f"{command} {words} {closed}", shell=True, cwd=ROOT, check=False,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        assert done.returncode == expected
    assert int(out.read_text()) > 2


@pytest.mark.parametrize(("redirected", "code"), [(">/dev/full", 2), ("2>/dev/full", 5)])
def test_an_output_on_a_full_disk_is_a_sentence_and_lost_errors_end_nothing(
    redirected: str, code: int
) -> None:
    command = f"{sys.executable} -m tests.orchestrate.framed letters {redirected}"
    done = subprocess.run(
        command, shell=True, cwd=ROOT, check=False, text=True, capture_output=True
    )
    assert done.returncode == code
    assert ("No space left on device" in done.stderr) == (code == 2)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_hang_up_is_a_request_to_end(number: signal.Signals) -> None:
    with waiting(lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL)) as running:  # under nohup
        running.send_signal(number)
        out, err = running.communicate()
    assert running.returncode == 5, out + err
    assert "finishing running trials" in err


def test_a_hang_up_that_nohup_ignores_stays_ignored() -> None:
    with waiting(lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)) as running:
        running.send_signal(signal.SIGHUP)
        with pytest.raises(subprocess.TimeoutExpired):
            running.wait(0.5)
        running.send_signal(signal.SIGTERM)
        assert running.wait() == 5


def waiting(before: Callable[[], Any] | None = None) -> subprocess.Popen[str]:
    """Start the program of the tests; it waits for a signal."""
    running = subprocess.Popen(
        [sys.executable, "-m", "tests.orchestrate.framed", "wait"],
        cwd=ROOT, env=without_coverage(), text=True, preexec_fn=before,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert running.stdout is not None
    assert running.stdout.readline() == "ready\n"
    return running


def test_letters_that_a_terminal_does_not_know_are_written_as_their_codes() -> None:
    plain = LETTERS.encode("ascii", "backslashreplace").decode()
    done = started("letters", PYTHONIOENCODING="ascii:strict")
    assert (done.returncode, done.stdout) == (5, plain)
    assert done.stderr == f"{plain}\n"
    done = started("letters", LC_ALL="POSIX", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert (done.returncode, done.stdout) == (5, plain)
    done = started("letters", PYTHONIOENCODING="latin-1")
    assert done.returncode == 5


def test_warnings_as_errors_end_no_program() -> None:
    done = started("warn", PYTHONWARNINGS="error")
    assert done.returncode == 5, done.stderr
    assert "a library is old" in done.stderr


# The programs


def run_program(words: list[str], cwd: Path, **environment: str) -> tuple[int, str, str]:
    first = [str(ROOT / words[0])] if words[0].endswith(".py") else words
    done = subprocess.run(
        [sys.executable, *first, *words[len(first) :]], cwd=cwd,
        env={**without_coverage(), "PYTHONPATH": str(ROOT), **environment},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("loaded", ["dopt.errors", "numpy", "sqlalchemy"])
@pytest.mark.parametrize("words", PROGRAMS, ids=lambda words: words[-1])
def test_an_interrupt_while_libraries_load_ends_a_program_with_130_and_no_traceback(
    words: list[str], loaded: str, tmp_path: Path
) -> None:
    first = [str(ROOT / words[0])] if len(words) == 1 else words
    command = [sys.executable, "-X", "importtime", *first, WORDS[words[-1]]]
    environment = {**without_coverage(), "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, text=True, stderr=subprocess.PIPE
    ) as running:
        assert running.stderr is not None
        lines = []
        for line in running.stderr:
            lines.append(line)
            if line.endswith(f" {loaded}\n"):
                running.send_signal(signal.SIGINT)
    assert running.returncode == 130, "".join(lines[-30:])
    assert all(line.startswith("import time:") for line in lines)


@pytest.mark.parametrize("words", PROGRAMS, ids=lambda words: words[-1])
def test_a_deleted_folder_is_named(words: list[str], tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    first = str(ROOT / words[0]) if len(words) == 1 else " ".join(words)
    command = f"rmdir {gone}; exec {sys.executable} {first} {WORDS[words[-1]]}"
    done = subprocess.run(
        command, shell=True, cwd=gone, env={**without_coverage(), "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert re.fullmatch(f"error: [^\n]*{gone} [^\n]*deleted[^\n]*\n", done.stderr), done.stderr


@pytest.mark.parametrize("words", [*PROGRAMS, ["-m", "benchmarks"]], ids=lambda words: words[-1])
def test_every_program_says_its_version_and_commit(words: list[str], tmp_path: Path) -> None:
    code, out, err = run_program([*words, "--version"], tmp_path, DOPT_COMMIT="")
    commit = program.commit_of(ROOT)
    known = f", commit {commit}" if commit else ""
    assert (code, out, err) == (0, f"dopt {dopt.__version__}{known}\n", "")


def test_a_version_loads_no_library() -> None:
    heavy = {"numpy", "hydra", "sqlalchemy", "pandas"}
    assert not heavy & set(loaded_by("import orchestrate.program"))


def test_outside_a_repository_the_version_has_the_commit_of_the_image(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(program, "ROOT", tmp_path)
    monkeypatch.delenv("DOPT_COMMIT", raising=False)
    assert "commit" not in program.version()
    monkeypatch.setenv("DOPT_COMMIT", "a1b2")
    assert program.version().endswith(", commit a1b2")


def test_texts_name_the_program_that_was_started(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "python -m orchestrate work, python -m analysis serve, python orchestrate/launch.py -m"
    monkeypatch.setattr(sys, "argv", ["/usr/lib/orchestrate/__main__.py"])
    assert as_started(text) == text
    monkeypatch.setattr(sys, "argv", ["/usr/bin/dopt", "status"])
    assert as_started(text) == "dopt work, dopt-analysis serve, dopt-launch -m"


def test_python_without_assertions_is_refused_by_name(tmp_path: Path) -> None:
    words = ["orchestrate/launch.py", "env=pendulum"]
    code, _, err = run_program(words, tmp_path, PYTHONOPTIMIZE="2")
    assert code == 2
    assert re.fullmatch("error: [^\n]*unset PYTHONOPTIMIZE[^\n]*\n", err), err
    assert not os.listdir(tmp_path)  # noqa: PTH208


@pytest.mark.parametrize(
    ("word", "safe"),
    [
        ("store.url=postgresql://me:pa:ss@host:5432/db", "store.url=postgresql://me:***@host:5432/db"),
        ("postgresql+psycopg://:pw@host/db", "postgresql+psycopg://:***@host/db"),
        ("--db=postgresql://h/db?user=me&password=pw&x=1", "--db=postgresql://h/db?user=me&password=***&x=1"),
        ("postgresql://me:p@ss@host/db?sslpassword=a@b", "postgresql://me:***@host/db?sslpassword=***"),
        ("sqlite:///results/results.db", "sqlite:///results/results.db"),
        ("ray://host:10001", "ray://host:10001"),
        ("postgresql://host:5432/db", "postgresql://host:5432/db"),
        ("policy=glob(*)", "policy=glob(*)"),
    ],
)  # fmt: skip
def test_the_rest_of_a_word_stays(word: str, safe: str) -> None:
    assert without_password_in_word(word) == safe
    assert without_password(word) == safe


def test_a_sentence_keeps_its_other_words() -> None:
    sentence = "cannot reach postgresql://me:secret@host:1/db, nor ray://host:2: ask me@example.org"
    assert without_password(sentence) == sentence.replace("secret", "***")


PLACES: dict[str, Callable[[str], str]] = {
    "a URL": lambda password: f"store.url=postgresql://me:{quote(password, safe='')}@host:5432/db",
    "a URL, as it is": lambda password: f"store.url=postgresql://me:{password}@host:5432/db",
    "a quoted URL": lambda password: f"store.url='postgresql://me:{quote(password)}@host/db'",
    "a section": lambda password: f"store={{url:'postgresql://:{quote(password)}@host/db'}}",
    "the query": lambda password: f"store.url=postgresql://host/db?password={quote(password)}",
    "a key's": lambda password: f"--db=postgresql://host/db?x=1&sslpassword={quote(password)}&y=2",
    "a cluster": lambda password: f"launch.ray.address=ray://me:{quote(password, safe='')}@host",
}
PASSWORDS = st.text(
    st.characters(codec="ascii", exclude_categories=["Cc", "Cs"]), min_size=8, max_size=20
).filter(lambda text: text.strip() == text and not set(text) & set("@&'"))


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(password=PASSWORDS, place=st.sampled_from(sorted(PLACES)))
def test_no_password_of_a_command_line_is_written_down_or_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, password: str, place: str
) -> None:
    word = PLACES[place](password)
    monkeypatch.setattr(sys, "argv", ["launch.py", word])
    record = launch_record(sys.argv, [word], tmp_path)
    trouble = f"Traceback: connecting with {password!s} failed\nValueError: {word}"
    shown = "\n".join([*record.argv, *record.overrides, without_password(trouble)])
    assert password not in shown
    assert quote(password, safe="") not in shown
    assert quote(password) not in shown


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(password=PASSWORDS, name=st.sampled_from(["PGPASSWORD", "MY_DB_PASSWORD", "A_TOKEN"]))
def test_no_password_of_the_environment_is_said(
    monkeypatch: pytest.MonkeyPatch, password: str, name: str
) -> None:
    monkeypatch.setattr(sys, "argv", ["launch.py"])
    with monkeypatch.context() as variables:
        variables.setenv(name, password)
        assert password not in without_password(f"'{password}' was refused; {password}")
    with monkeypatch.context() as variables:
        variables.setenv("DOPT_DB", f"postgresql://me:{quote(password, safe='')}@host/db")
        assert password not in without_password(f"'{password}' was refused; {password}")


PASSWORD = "never to be seen"


def leaking(_: TrialSpec) -> TrialResult:
    """Say the password as a library does that prints its environment."""
    raise ConnectionError(f"cannot connect with {os.environ['PGPASSWORD']} to {os.environ['MINE']}")


def test_no_row_of_the_database_holds_a_password_that_a_trial_said(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PGPASSWORD", PASSWORD)
    monkeypatch.setenv("MINE", "postgresql://me:another%20secret@host/db")
    launches(leaking, seeds=2)
    rows = str(launches.query("SELECT type, message, traceback FROM error"))
    assert "ConnectionError" in rows
    assert "cannot connect with *** to postgresql://me:***@host/db" in rows
    assert PASSWORD not in rows
    assert "another" not in rows


@settings(
    max_examples=3,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    phases=[Phase.generate],  # a launch is too slow to look for a shorter password
)
@given(password=PASSWORDS.map(lambda text: f"{text}~{text}"))  # a plain word may be there anyway
def test_neither_a_row_nor_a_word_of_a_launch_holds_a_password(
    command_line: Callable[..., tuple[int, str, str]], tmp_path: Path, password: str
) -> None:
    quoted = quote(password, safe="")
    server = f"postgresql://me:{quoted}@127.0.0.1:1/db?application_name=dopt"
    short = ("env.horizon=5", "executor=inprocess", "launch.patience=0.3")
    code, output, errors = command_line("-m", "seed=1,2", f"store.url='{server}'", *short)
    assert code == 75, errors
    address = f"launch.ray.address='ray://me:{quoted}@host:1'"
    code, more, _ = command_line("-m", "seed=1,2", address, *short)
    assert code == 0
    files = [path for path in (tmp_path / "results").rglob("*") if path.is_file()]
    stored = b"".join(path.read_bytes() for path in files)
    for shown in (output.encode(), errors.encode(), more.encode(), stored):
        assert password.encode() not in shown
        assert quoted.encode() not in shown
    assert b"ray://me:***@host:1" in stored


def full() -> OSError:
    return OSError(errno.ENOSPC, "No space left on device")


def test_a_torn_file_is_removed_and_the_cause_named(tmp_path: Path) -> None:
    target = tmp_path / "new" / "table.csv"
    with pytest.raises(OutputError, match=r"table.csv cannot be written \(No space left on device"):  # noqa: SIM117, PT012
        with whole(target) as part:
            part.write_text("half")
            raise full()
    assert list(target.parent.iterdir()) == []
    with whole(target) as part:
        part.write_text("all")
    assert [path.name for path in target.parent.iterdir()] == ["table.csv"]


def test_an_error_of_a_library_that_a_full_disk_caused_is_recognised(tmp_path: Path) -> None:
    """Matplotlib closes a PDF that it could not begin, and fails once more."""
    with pytest.raises(OutputError, match="No space left"), writing(tmp_path):  # noqa: PT012
        try:
            raise full()
        finally:
            raise AttributeError("'Stream' object has no attribute 'pos'")
    with pytest.raises(OutputError, match="No space left on device"), writing(tmp_path):
        raise RuntimeError("(sqlite3.OperationalError) database or disk is full")


@pytest.mark.parametrize("error", [ValueError("no"), DoptError("the disk is full")])
def test_other_errors_stay_as_they_are(error: Exception, tmp_path: Path) -> None:
    with pytest.raises(type(error), match=str(error)), writing(tmp_path):
        raise error


def test_devices_are_not_replaced_and_a_folder_below_a_file_is_a_sentence(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OutputError, match="it is no file"), whole(pipe) as part:
        part.write_text("all")
    assert pipe.is_fifo()
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file/x cannot be written \(Not a directory\)"):
        make_folder(tmp_path / "file" / "x")
