"""Texts of a database reach a terminal without what would command it."""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Callable
from dataclasses import replace

import pytest

from analysis.cli import main as analysis
from orchestrate.program import visible
from orchestrate.store import Failure, Store
from tests.orchestrate.commands.conftest import Answer, run_now
from tests.orchestrate.store.fakes import LAUNCH, Spec, result
from tests.orchestrate.store.places import execute

EVIL = "\x1b]52;c;cm0gLXJmIH4=\x07\x1b[2J\x9b31m\r\u202egpj.exe\x00"
SHOWN = r"\x1b]52;c;cm0gLXJmIH4=\x07\x1b[2J\x9b31m\r\u202egpj.exe"
STORED = EVIL.rstrip("\0")


@pytest.fixture
def evil(store: Store, url: str) -> str:
    """Fill the database with texts that would command a terminal."""
    number = store.begin_launch(replace(LAUNCH, host=STORED, argv=("launch.py", STORED)))
    claims = store.claim(number, store.register(number, [Spec(0), Spec(1), Spec(2)]).todo)
    store.commit(claims[0], result(0), replace(run_now(), node=STORED))
    traceback = f"Traceback (most recent call last):\n  File {STORED}\nValueError: {STORED}"
    store.fail(claims[1], Failure("ValueError", STORED, traceback, "exception"), run_now())
    execute(url, f"UPDATE config SET label = '{STORED}', env = '{STORED}'")
    return url


def is_harmless(text: str) -> bool:
    return all(one in "\n\t" or unicodedata.category(one) not in ("Cc", "Cs") for one in text) and (
        not set(text) & set("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u200e\u200f")
    )


@pytest.mark.parametrize(
    "words",
    [
        ["status", "--all"],
        ["show", "--seed", "0"],
        ["show", "--seed", "1"],
        ["query", "SELECT label, host, message FROM config, launch, error"],
        ["doctor"],
        ["prune", "--dry-run", "--older-than", "1s"],
        ["export", "trials", "/nowhere\x1b[2J/x.csv"],
        ["status", "--env", STORED + "x"],
    ],
    ids=" ".join,
)
def test_commands(evil: str, command: Callable[..., Answer], words: list[str]) -> None:  # noqa: ARG001
    answer = command(*words)
    assert is_harmless(answer.out + answer.err), ascii(answer.out + answer.err)


def test_what_is_shown(evil: str, command: Callable[..., Answer]) -> None:  # noqa: ARG001
    """Rich leaves a bell and the return to the beginning of a line out of its texts."""
    assert SHOWN.replace(r"\x07", "").replace(r"\r", "") in command("status").out
    assert f"ValueError: {SHOWN}" in command("show", "--seed", "1").out


def test_the_analysis(evil: str, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (
        ["summary"],
        ["summary", "--format", "latex"],
        ["compare"],
        ["summary", "--env", "x"],
    ):
        analysis([*words, "--db", evil, "--allow-partial"])
        output = capsys.readouterr()
        assert is_harmless(output.out + output.err), ascii(output.out + output.err)


def test_what_programs_read_stays_exact(evil: str, command: Callable[..., Answer]) -> None:  # noqa: ARG001
    sql = "SELECT label FROM config"
    assert command("query", "--csv", sql).out == f"label\n{STORED}\n"
    assert json.loads(command("query", "--json", sql).out)["rows"] == [[STORED]]


def test_colours_of_the_program_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    from orchestrate.commands.command import console

    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    screen = console()
    with screen.capture() as captured:
        screen.print(f"a{STORED}", style="bold red")
    assert captured.get().startswith("\x1b[1;31m")
    assert SHOWN.replace(r"\x07", "").replace(r"\r", "") in captured.get()


def test_letters_of_every_language_stay() -> None:
    text = "déjà vu, Ελληνικά, 日本語, עברית, العربية, 👩‍🔬 ∞\tµ\n"
    assert visible(text) == text
    assert visible(EVIL) == SHOWN + r"\x00"
