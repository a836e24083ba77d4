"""The page of bundles and trackers is true: its commands run in their order, and its programs."""

from __future__ import annotations

import shlex
import warnings
from pathlib import Path

import pytest

from orchestrate.store.bundle import TABLES, file_name
from tests.analysis.synthetic import fill, make_grid
from tests.pages import PAGES, blocks
from tests.test_docs import SHARING, SHORT
from tests.typed_commands import empty_folder, run_typed


def test_its_commands_and_programs_run_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for library in ("duckdb",):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pytest.importorskip(library, reason="needs the extra all")
    empty_folder(tmp_path, monkeypatch)
    fill("sqlite:///results/results.db", make_grid(("pendulum",), seeds=range(3), **SHORT))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries, about what they use of others
        for block in blocks(PAGES[SHARING], "bash"):
            for line in block.splitlines():
                run_typed(shlex.join(shlex.split(line, comments=True)), monkeypatch, capsys)
    for program in blocks(PAGES[SHARING], "python"):
        exec(compile(program, SHARING, "exec"), {})
        assert "loss" in capsys.readouterr().out or "duckdb" in program
    for name in ("bundle", "pendulum"):
        assert (tmp_path / "exported" / name / "provenance.json").is_file()
    assert (tmp_path / "figures" / "bundle" / "figure1.pdf").is_file()


def test_it_names_every_file_of_a_bundle() -> None:
    for name in (*map(file_name, TABLES), "views.sql", "README.md", "SHA256SUMS"):
        assert f"`{name}`" in PAGES[SHARING]
