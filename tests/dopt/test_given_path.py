"""Paths that users give, as one function reads them."""

from __future__ import annotations

import logging
import pwd
from pathlib import Path

import pytest

from dopt import Explorer
from dopt.errors import SpecificationError, _say_once, given_path
from tests.dopt.explorer.plants import MOTOR

PLAIN = ["r.db", "/a/b c.db", "price$", "a$-b", "./~x", "%7E/x", "./ x", "é", "a~b", "\udcff.db"]
REFUSED = ["", " \n", "$HOME/r.db", "/data/$USER/r.db", "${HOME}/x", "$(pwd)/x", "~nobody-here/x"]


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    _say_once.cache_clear()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "home"


@pytest.mark.parametrize("given", PLAIN)
def test_a_path_stays_as_it_is(given: str, caplog: pytest.LogCaptureFixture) -> None:
    assert given_path(given, "--out") == Path(given)
    assert not caplog.records


@pytest.mark.parametrize(
    "around", ["{} ", " {}", "{}\n", "{}\r\n", "\t{} \n", "{}\N{NO-BREAK SPACE}"]
)
def test_what_is_around_a_path_is_left_out_with_one_note(
    around: str, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(2):
        assert given_path(around.format("x/r.db"), "DOPT_CACHE") == Path("x/r.db")
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.message == "DOPT_CACHE: the blanks or line ends around it are left out"


def test_a_tilde_is_the_home_folder(home: Path) -> None:
    assert given_path("~", "--out") == home
    assert given_path("~/x/r.db", "--out") == home / "x/r.db"
    assert given_path("~root/r.db", "--out") == Path(pwd.getpwnam("root").pw_dir, "r.db")


CODE = r"--out holds the control character '\\\w+'"


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        *((given, r"--out is '.*give") for given in REFUSED),
        *((given, CODE) for given in ("a\nb", "a\0b", "a\x1b[2Jb", "a\x9bb")),
    ],
)
def test_what_a_shell_expands_and_control_characters_are_refused(given: str, sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        given_path(given, "--out")


def test_a_folder_that_is_named_like_a_variable_is_found(tmp_path: Path) -> None:
    (tmp_path / "$HOME").mkdir()
    (tmp_path / "a${b}c").mkdir()
    assert given_path("$HOME/r.db", "--out") == Path("$HOME/r.db")
    assert given_path(f"{tmp_path}/a${{b}}c/r.db", "--out") == tmp_path / "a${b}c/r.db"
    with pytest.raises(SpecificationError, match=r"\$X is expanded by a shell"):
        given_path("$HOME/$X/r.db", "--out")


def test_a_journal(home: Path) -> None:
    Explorer(MOTOR, journal="~/runs/one.jsonl\n").close()
    assert [path.name for path in (home / "runs").iterdir()] == ["one.jsonl"]
    with pytest.raises(SpecificationError, match=r"journal is '\$HOME/one.jsonl'"):
        Explorer(MOTOR, journal="$HOME/one.jsonl")
