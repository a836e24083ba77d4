"""The page of sharing is true: its commands run in their order, and its program."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from tests.analysis.synthetic import fill, make_grid
from tests.pages import PAGES, blocks
from tests.test_docs import SHARING, SHORT
from tests.typed_commands import empty_folder, run_typed


def test_its_commands_and_programs_run_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    empty_folder(tmp_path, monkeypatch)
    fill("sqlite:///results/results.db", make_grid(("pendulum",), seeds=range(3), **SHORT))
    for block in blocks(PAGES[SHARING], "bash"):
        for line in block.splitlines():
            run_typed(shlex.join(shlex.split(line, comments=True)), monkeypatch, capsys)
    for program in blocks(PAGES[SHARING], "python"):
        exec(compile(program, SHARING, "exec"), {})
        assert "pendulum" in capsys.readouterr().out
    assert (tmp_path / "figures" / "all" / "figure1.pdf").is_file()
