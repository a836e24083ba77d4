"""Common parts of all commands: words, refusals, exit codes, pipes."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from orchestrate.__main__ import main
from orchestrate.commands import COMMANDS
from orchestrate.commands.command import Command
from orchestrate.errors import ExitCode
from orchestrate.program import Parser
from orchestrate.store import Store
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS

READING = [
    ["status"],
    ["show", "--seed", "1"],
    ["retry", "failed"],
    ["query", "SELECT 1"],
    ["export", "curves", "--out", "curves.csv"],
]

Capture = pytest.CaptureFixture[str]


def refusal(words: list[str], capsys: Capture) -> tuple[int, str]:
    """Return the exit code and the one line on the standard error."""
    code = main(words)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    return code, err


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"]])
def test_without_a_command_it_lists_them(words: list[str], capsys: Capture) -> None:
    assert main(words) == 0
    out, _ = capsys.readouterr()
    for command in COMMANDS:
        assert f"  {command.name} " in out
        assert command.help in out


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_every_command_has_help_and_the_common_options(command: Command, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as end:
        main([command.name, "--help"])
    assert end.value.code == 0
    out, _ = capsys.readouterr()
    assert "--db URL" in out
    assert "--json" in out


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["statsu"], "did you mean 'status'?"),
        (["status", "--evn", "pendulum"], "did you mean '--env'?"),
        (["retry", "faild"], "did you mean 'failed'?"),
        (["retry"], "see python -m orchestrate retry --help"),
        (["status", "more"], "unexpected argument 'more'"),
        (["query", "SELECT 1", "--limit", "0"], "a whole number above 0 is expected"),
        (["query", "SELECT 1", "--timeout", "nan"], "a number above 0 is expected"),
        (["status", "--watch", "soon"], "a number above 0 is expected"),
        (["show", "--seed", "one"], "a whole number from 0 to 2^63 - 1 is expected"),
        (["export", "curves", "--out", "x", "--format", "parket"], "did you mean 'parquet'?"),
        (["export", "curves", "--out", "curves.xlsx"], "give --format"),
        (["status", "--db", "results.db"], "The database URL cannot be read"),
    ],
)
def test_a_bad_request_is_one_sentence(words: list[str], hint: str, capsys: Capture) -> None:
    code, sentence = refusal(words, capsys)
    assert code == ExitCode.BAD_REQUEST
    assert hint in sentence


@pytest.mark.parametrize("words", READING, ids=lambda words: words[0])
class TestOnEveryDatabase:
    def test_no_database(self, words: list[str], tmp_path: Path, capsys: Capture) -> None:
        code, sentence = refusal([*words, "--db", f"sqlite:///{tmp_path}/none.db"], capsys)
        assert code == ExitCode.BAD_REQUEST
        assert "There is no results database" in sentence
        assert list(tmp_path.iterdir()) == []

    def test_no_server(self, words: list[str], capsys: Capture) -> None:
        url = "postgresql://me:hunter2@127.0.0.1:1/db"
        code, sentence = refusal([*words, "--db", url], capsys)
        assert code == ExitCode.INFRASTRUCTURE
        assert "hunter2" not in sentence

    def test_a_newer_database(
        self, words: list[str], url: str, store: Store, capsys: Capture
    ) -> None:
        with store._backend.transaction() as connection:
            connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
        code, sentence = refusal([*words, "--db", url], capsys)
        assert code == ExitCode.BAD_REQUEST
        assert "update the program" in sentence

    def test_an_older_database(
        self, words: list[str], url: str, store: Store, capsys: Capture
    ) -> None:
        with store._backend.transaction() as connection:
            connection.exec_driver_sql("UPDATE alembic_version SET version_num = '5'")
        code, sentence = refusal([*words, "--db", url], capsys)
        assert code == ExitCode.BAD_REQUEST
        assert "python -m orchestrate upgrade --db" in sentence

    def test_an_empty_database(
        self,
        words: list[str],
        url: str,
        store: Store,  # noqa: ARG002 it creates the database
        capsys: Capture,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.chdir(tmp_path)
        refused = words[0] in ("show", "export")
        assert main([*words, "--db", url]) == (ExitCode.BAD_REQUEST if refused else 0)
        out, err = capsys.readouterr()
        assert (err if refused else out).strip()
        assert not list(tmp_path.glob("curves*"))
        if not refused:
            assert main([*words, "--json", "--db", url]) == 0
            json.loads(capsys.readouterr().out)


def test_the_database_comes_from_the_environment(
    sqlite_url: str, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    Store.open(sqlite_url).close()
    monkeypatch.setenv("DOPT_DB", sqlite_url)
    assert main(["status"]) == 0
    assert f"{sqlite_url} holds no trials yet" in capsys.readouterr().out


def test_a_path_in_the_variable_is_answered_with_the_variable_and_the_url(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setenv("DOPT_DB", "mine/x.db")
    assert main(["status"]) == 2
    assert capsys.readouterr().err == (
        "error: The database URL in the environment variable DOPT_DB cannot be read: "
        "write it as sqlite:///mine/x.db.\n"
    )


def test_the_entry_point_is_the_same_program(monkeypatch: pytest.MonkeyPatch) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    module, _, function = project["scripts"]["dopt"].partition(":")
    packages = {name: one for name, one in sys.modules.items() if name == "orchestrate"}
    started: list[str] = []
    monkeypatch.setattr("orchestrate.program.run", started.append)
    try:
        getattr(importlib.import_module(module), function)()
    finally:
        sys.modules.update(packages)
    assert started == ["orchestrate.__main__"]


def test_an_option_is_not_abbreviated() -> None:
    parser = Parser(prog="x")
    parser.add_argument("--policy")
    assert parser.read(["--policy", "a"]).policy == "a"
    with pytest.raises(Exception, match="did you mean '--policy'"):
        parser.read(["--polic", "a"])


def test_a_reader_that_has_seen_enough_ends_it_quietly(sqlite_url: str) -> None:
    with Store.open(sqlite_url) as store:
        launch = store.begin_launch(LAUNCH)
        specs = [Spec(seed, horizon=2000) for seed in range(5)]
        for claim in store.claim(launch, store.register(launch, specs).todo):
            store.commit(claim, result(0, 2000), RUN)
    program = [sys.executable, "-m", "orchestrate", "query", "SELECT * FROM v_curve", "--csv"]
    running = subprocess.Popen(
        [*program, "--db", sqlite_url], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert running.stdout is not None
    assert running.stderr is not None
    assert running.stdout.readline().startswith(b"config_key")
    running.stdout.close()
    assert running.stderr.read() == b""
    running.stderr.close()
    assert running.wait(timeout=PATIENCE_SECONDS) == 0


def test_ctrl_c_ends_a_watch_with_130(sqlite_url: str) -> None:
    with Store.open(sqlite_url) as store:
        store.register(store.begin_launch(LAUNCH), [Spec()])
        program = [sys.executable, "-m", "orchestrate", "status", "--watch", "0.1"]
        running = subprocess.Popen(
            [*program, "--db", sqlite_url],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        assert running.stdout is not None
        assert b"0 of 1 trials" in running.stdout.readline()
        time.sleep(0.2)
        running.send_signal(signal.SIGINT)
        _, err = running.communicate(timeout=PATIENCE_SECONDS)
    assert running.returncode == ExitCode.INTERRUPTED
    assert err == b""
