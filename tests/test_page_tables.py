"""The tables of the pages are made from their CSV files."""

from __future__ import annotations

import importlib.util
import re
import shutil
from pathlib import Path
from types import ModuleType

import pytest

from tests.paths import ROOT


def tables(docs: Path) -> ModuleType:
    """Load ``docs/tables.py`` for a folder of pages and CSV files."""
    spec = importlib.util.spec_from_file_location("page_tables", ROOT / "docs/tables.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.DOCS = docs  # type: ignore[attr-defined]
    return module


def test_the_pages_have_the_tables_of_their_files() -> None:
    assert tables(ROOT / "docs").main(check=True) == 0


def test_every_table_stands_on_a_page() -> None:
    made = tables(ROOT / "docs")
    text = "".join((ROOT / "docs" / page).read_text() for page in made.PAGES)
    assert set(made.TABLES) == set(re.findall(r"<!-- table: (\w+) -->", text))
    assert text.count("<!-- table: ") == text.count("<!-- end -->")


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """Copy the pages and CSV files, with the README beside them."""
    shutil.copy(ROOT / "README.md", tmp_path)
    for path in (ROOT / "docs").rglob("*"):
        if path.suffix in {".csv", ".md"}:
            copy = tmp_path / "docs" / path.relative_to(ROOT / "docs")
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, copy)
    return tmp_path / "docs"


def test_a_changed_number_is_noticed_and_written(
    copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = copied / "summary.csv"
    first = summary.read_text().splitlines()[1].split(",")[3]
    summary.write_text(summary.read_text().replace(first, "7.5"))
    assert tables(copied).main(check=True) == 1
    assert "README.md differs from its sources" in capsys.readouterr().err
    assert tables(copied).main(check=False) == 0
    assert "7.50" in (copied / "../README.md").read_text()
    assert tables(copied).main(check=True) == 0
