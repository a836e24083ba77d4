"""Words of the command lines that were removed name what takes their place."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from orchestrate.__main__ import main
from orchestrate.program import SUCCESSORS


@pytest.mark.parametrize("word", [name for name in SUCCESSORS if name.startswith("launch.")])
def test_settings_of_a_launch(command_line: Callable[..., tuple[int, str, str]], word: str) -> None:
    code, output, errors = command_line("-m", word if "=" in word else f"{word}=1")
    assert (code, output) == (2, "")
    assert errors == f"error: '{word}' was removed: {SUCCESSORS[word]}.\n"


@pytest.mark.parametrize("words", [["work", "--live", "1"], ["work", "--live=1"]])
def test_options(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    assert f"'--live' was removed: {SUCCESSORS['--live']}." in capsys.readouterr().err
