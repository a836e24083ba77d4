"""Pages for readers: their links, their tables, the README, and the page of the database."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
from pathlib import Path
from types import ModuleType

import pytest

from orchestrate.store import Reader
from orchestrate.store.schema import SCHEMA_VERSION, VIEWS, metadata
from tests.analysis.synthetic import fill, make_grid
from tests.pages import GENERATED, PAGES, anchors, blocks, links
from tests.paths import ROOT, loaded
from tests.test_docs import SHORT, TASK

MADE = {"docker/secrets"}
"""Paths that a command of a page writes."""


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_to_a_file_and_a_heading(page: str) -> None:
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text()), link


def test_every_file_that_a_page_names_exists() -> None:
    folders = "analysis|benchmarks|conf|docker|docs|dopt|orchestrate|studies|tests"
    for page, text in PAGES.items():
        for path in re.findall(rf"`((?:{folders})/[\w./-]+)`", text):
            if page not in GENERATED and path not in MADE:
                assert (ROOT / path).exists(), f"{page}: {path}"


def test_no_page_says_that_it_is_out_of_date() -> None:
    for page, text in PAGES.items():
        assert not re.search(r"out of date|outdated|no longer true|earlier version of", text), page


def tables(docs: Path) -> ModuleType:
    """Load ``docs/tables.py`` for a folder of pages and CSV files."""
    module = loaded(ROOT / "docs/tables.py")
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


README = PAGES["README.md"]
LONGEST = 900
"""Words that the README may have, as ``wc -w`` counts them."""


def test_it_is_short() -> None:
    assert len(README.split()) <= LONGEST


def test_its_example_runs() -> None:
    (example,) = blocks(README, "python")
    assert len(example.strip().splitlines()) <= 10
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        exec(compile(example, "README.md", "exec"), {})
    loss, states, inputs = output.getvalue().strip().split(" ", 1)[0], "(501, 2)", "(500, 1)"
    assert 0 < float(loss) < 10
    assert output.getvalue().strip().endswith(f"{states} {inputs}")


@pytest.mark.parametrize(
    "part", ["docs/figure1.png", "make figures", "make test", "@inproceedings"]
)
def test_it_has_what_a_reader_looks_for(part: str) -> None:
    assert part in README


@pytest.mark.parametrize("paper", ["NeurIPS_ML4PS_2022_37", "2304.13426"])
def test_it_cites_the_paper_and_its_successor(paper: str) -> None:
    (entries,) = blocks(README, "bibtex")
    assert paper in entries
    assert README.count(paper) >= 2  # linked in the text as well


DATABASE = "docs/database.md"
QUERIES = [
    (question, query)
    for block in blocks(PAGES[DATABASE], "sql")
    for question, query in [block.removeprefix("-- ").split("\n", 1)]
]
EMPTY = {"what failed, and why?"}
"""Questions to which a grid without faults has no answer."""

INNER = {"alembic_version", "curve"}
"""Tables with nothing that other tables do not hold."""


@pytest.fixture(params=["sqlite", "postgresql"])
def small(request: pytest.FixtureRequest) -> str:
    """Return a small grid in a database of each kind."""
    url = str(request.getfixturevalue(f"{request.param}_url"))
    fill(url, make_grid(("pendulum", "cartpole"), seeds=range(8), **SHORT))
    fill(url, make_grid(("pendulum",), ("random",), seeds=range(8), **SHORT, **TASK))
    rail = {"limits": {"bounds": {"y": [-1.0, 1.0]}, "enforced": False}}
    fill(url, make_grid(("cartpole",), ("random",), seeds=range(8), **SHORT, **rail))
    return url


def _answers(url: str) -> dict[str, tuple[list[str], list[tuple[object, ...]]]]:
    """Return the columns and rows of every query of the page, numbers to nine digits."""
    with Reader.open(url) as reader:
        tables = {question: reader.query(query) for question, query in QUERIES}
    return {
        question: (list(table.columns), [tuple(map(_rounded, row)) for row in table])
        for question, table in tables.items()
    }


def _rounded(value: object) -> object:
    return f"{value:.9g}" if isinstance(value, float) else value


def test_every_query_answers_and_mixes_no_configurations(small: str) -> None:
    """A second configuration of a policy adds rows, but changes none and doubles no step."""
    before = _answers(small)
    for question, (_, rows) in before.items():
        assert rows or question in EMPTY, question
    other = {"env": {"horizon": 40, "gamma": 3.0}}
    fill(small, make_grid(("pendulum", "cartpole"), seeds=range(6), **other))
    fill(
        small,
        make_grid(("cartpole",), ("d_optimal",), range(6), policy={"regularization": 0.1}, **SHORT),
    )
    for question, (columns, rows) in _answers(small).items():
        assert set(before[question][1]) <= set(rows), question
        assert len(set(rows)) == len(rows), question
        if "t" in columns and "config_key" not in columns:
            steps = [row[columns.index("t")] for row in rows]
            assert len(set(steps)) == len(steps), question


def test_every_column_of_the_schema_is_described() -> None:
    described = re.findall(r"^\| `(\w+)` \| `(\w+)` \|", PAGES[DATABASE], flags=re.MULTILINE)
    own = [table for table in metadata.tables.values() if table.name not in INNER]
    stored = [(table.name, column.name) for table in own for column in table.columns]
    assert sorted(described) == sorted(stored)


def test_the_page_counts_its_queries() -> None:
    numbers = {"Six": 6, "Seven": 7, "Eight": 8, "Nine": 9}
    (said,) = re.findall(r"^## (\w+) useful queries$", PAGES[DATABASE], flags=re.MULTILINE)
    assert numbers[said] == len(QUERIES)


def test_every_table_and_view_is_described() -> None:
    page = PAGES[DATABASE]
    for name in (*metadata.tables, *VIEWS):
        assert f"`{name}`" in page or name == "alembic_version", name
    assert f"The schema is version {SCHEMA_VERSION}." in page


def test_every_column_of_a_view_is_named(sqlite_url: str) -> None:
    fill(sqlite_url, [])
    page = PAGES[DATABASE]
    shared = re.findall(r"`(\w+)`", page.split("Every view has the columns ")[1].split("|")[0])
    with Reader.open(sqlite_url) as reader:
        for view in VIEWS:
            (row,) = re.findall(rf"^\| `{view}` \| [^|]+ \| (.*) \|$", page, flags=re.MULTILINE)
            found = reader.query(f"SELECT * FROM {view}").columns
            assert list(found) == [*shared, *re.findall(r"`(\w+)`", row)], view
