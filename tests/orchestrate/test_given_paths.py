"""Paths that users give to the programs: every one is read by ``dopt.errors``."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from analysis.cli import main as analysis
from analysis.cli import parser as parser_of_analysis
from dopt.errors import _say_once
from orchestrate.__main__ import main as orchestrate
from orchestrate.commands import COMMANDS
from orchestrate.store import Reader, StoreError
from orchestrate.store.backends.sqlite_engine import existing_path
from orchestrate.store.database_url import parse
from tests.orchestrate.test_command_line import SHORT, Command
from tests.paths import ROOT

TRIAL = ("env=pendulum", "policy=random", *SHORT)


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    _say_once.cache_clear()
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.mark.parametrize(
    "given", ["sqlite:///~/r.db", "sqlite:///~/r.db\n", " sqlite:/// ~/r.db\t"]
)
def test_a_database_in_the_home_folder(
    command_line: Command, monkeypatch: pytest.MonkeyPatch, home: Path, given: str
) -> None:
    monkeypatch.setenv("DOPT_DB", given)
    code, output, errors = command_line(*TRIAL)
    assert (code, errors) == (0, "")
    assert output.rstrip().endswith(f"sqlite:///{home}/r.db")
    assert (home / "r.db").is_file()
    assert orchestrate(["status"]) == 0
    assert orchestrate(["status", "--db", f"{given} "]) == 0
    monkeypatch.delenv("DOPT_DB")
    assert "already done" in command_line(*TRIAL, f"store.url={given}")[1]
    assert [path.name for path in Path.cwd().iterdir()] == ["home"]


def test_a_variable_in_the_address_makes_no_folder(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOPT_DB", "sqlite:///${HOME}/r.db")
    code, output, errors = command_line(*TRIAL)
    assert (code, output) == (2, "")
    assert "in the environment variable DOPT_DB is '${HOME}/r.db', but ${HOME} is expand" in errors
    assert [path.name for path in Path.cwd().iterdir()] == ["home"]


def test_a_password_may_hold_what_a_path_may_not() -> None:
    url = parse("postgresql://me:$HOME%7E~%0A@host/dopt\n")
    assert (url.password, url.database) == ("$HOME~~\n", "dopt")
    with pytest.raises(StoreError, match="holds the control character") as raised:
        Reader.open("postgresql://me:secret@host/do\npt")
    assert "secret" not in str(raised.value)
    assert str(existing_path(parse("sqlite:////dev/../etc/hostname "))) == "/etc/hostname"


def parsers() -> Iterator[argparse.ArgumentParser]:
    yield from (command.parser() for command in COMMANDS)
    for action in parser_of_analysis()._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.values()


def test_no_option_takes_a_path_unread() -> None:
    actions = [one for parser in parsers() for one in parser._actions]
    assert not [one.dest for one in actions if one.type in (Path, os.fspath)]
    assert sum("given_path" in repr(one.type) for one in actions) >= 6


@pytest.mark.parametrize(
    "words",
    [["backup", "$X/r.db"], ["export", "curves", "--out", "$X/c.csv"], ["merge", "$X/other.db"]],
)
def test_options_of_the_commands(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert orchestrate(words) == 2
    assert "'$X/" in capsys.readouterr().err


def test_options_of_the_analysis(capsys: pytest.CaptureFixture[str]) -> None:
    assert analysis(["figures", "--out", "$X/f"]) == 2
    assert "--out is '$X/f', but $X is expanded by a shell" in capsys.readouterr().err


def test_the_cache_of_the_kernel(tmp_path: Path, home: Path) -> None:
    def run(folder: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, str(ROOT / "orchestrate/launch.py"), *TRIAL, "launch.dry_run=true"],
            env={**os.environ, "DOPT_CACHE": folder},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )

    refused = run("$HOME/cache")
    assert refused.returncode == 2
    assert refused.stderr.startswith("error: DOPT_CACHE is '$HOME/cache', but $HOME is expanded")
    assert run("~/cache\n").returncode == 0
    assert [path.name for path in home.iterdir()] == ["cache"]
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
