"""Pages for readers: links, tables, the README, the pages of database and sharing, notebooks."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import shutil
from pathlib import Path
from types import ModuleType

import matplotlib.pyplot as plt
import nbformat
import pytest
from nbclient import NotebookClient

from orchestrate.store import Reader
from orchestrate.store.schema import SCHEMA_VERSION, VIEWS, metadata
from tests.analysis.synthetic import fill, make_grid
from tests.pages import GENERATED, PAGES, anchors, blocks, links
from tests.paths import ROOT, loaded
from tests.test_docs import SHARING, SHORT, TASK
from tests.typed_commands import empty_folder, run_typed

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


def test_a_changed_number_is_noticed_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a copy of the README, beside the files."""
    shutil.copy(ROOT / "README.md", tmp_path)
    copied = tmp_path / "docs"
    pictures = shutil.ignore_patterns("vendor", "*.png", "*.gif")
    shutil.copytree(ROOT / "docs", copied, ignore=pictures)
    made, summary = tables(copied), copied / "summary.csv"
    made.PAGES = ("../README.md",)  # type: ignore[attr-defined]  # a module found by its path
    first = summary.read_text().splitlines()[1].split(",")[3]
    summary.write_text(summary.read_text().replace(first, "7.5"))
    assert made.main(check=True) == 1
    assert "README.md differs from its sources" in capsys.readouterr().err
    assert made.main(check=False) == 0
    assert "7.50" in (tmp_path / "README.md").read_text()
    assert made.main(check=True) == 0


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


def test_it_cites_the_paper_and_its_successor() -> None:
    (entries,) = blocks(README, "bibtex")
    for paper in ("NeurIPS_ML4PS_2022_37", "2304.13426"):
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


def test_every_column_table_and_view_is_described_and_queries_are_counted() -> None:
    described = re.findall(r"^\| `(\w+)` \| `(\w+)` \|", PAGES[DATABASE], flags=re.MULTILINE)
    own = [table for table in metadata.tables.values() if table.name not in INNER]
    stored = [(table.name, column.name) for table in own for column in table.columns]
    assert sorted(described) == sorted(stored)
    numbers = {"Six": 6, "Seven": 7, "Eight": 8, "Nine": 9}
    (said,) = re.findall(r"^## (\w+) useful queries$", PAGES[DATABASE], flags=re.MULTILINE)
    assert numbers[said] == len(QUERIES)
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


def test_commands_and_programs_of_the_page_of_sharing_run_in_their_order(
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


NOTEBOOK, PLANT = (
    nbformat.read(ROOT / "docs" / name, as_version=4) for name in ("explore.ipynb", "plant.ipynb")
)


@pytest.mark.parametrize(("notebook", "pictures"), [(NOTEBOOK, 3), (PLANT, 2)])
def test_a_notebook_is_executed(notebook: nbformat.NotebookNode, pictures: int) -> None:
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert sum("image/png" in str(cell.outputs) for cell in cells) >= pictures


def test_the_notebook_of_a_plant_runs_in_ten_cells_without_a_database(tmp_path: Path) -> None:
    assert len(PLANT.cells) == 10
    text = " ".join(cell.source for cell in PLANT.cells)
    assert not re.search(r"\b(hydra|ray|sql)", text, re.IGNORECASE)
    place = {"metadata": {"path": str(tmp_path)}}
    done = NotebookClient(nbformat.from_dict(PLANT), resources=place).execute()
    [error] = [cell.outputs[0] for cell in done.cells if "free_run_error" in cell.source]
    assert float(error["data"]["text/plain"]) < 0.05


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the root of a repository whose database has two configurations of a policy.

    The other configuration has as many trials.
    """
    url = f"sqlite:///{tmp_path}/results/results.db"
    (tmp_path / "docs").mkdir()
    for fields in ({"horizon": 40}, {"horizon": 40, "gamma": 3.0}):
        systems = ("pendulum", "cartpole")
        fill(url, make_grid(systems, ("d_optimal", "random"), range(6), env=fields))
    monkeypatch.delenv("DOPT_DB", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return tmp_path


def test_a_notebook_runs_in_docs(root: Path) -> None:
    place = {"metadata": {"path": str(root / "docs")}}
    client = NotebookClient(nbformat.from_dict(NOTEBOOK), resources=place)
    client.execute()  # raises what a cell raises


def test_cells_of_a_notebook_run_in_the_root(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(root)
    names: dict[str, object] = {}
    for cell in NOTEBOOK.cells:
        if cell.cell_type == "code":
            exec(cell.source, names)
    assert len(plt.get_fignums()) >= 1
    plt.close("all")


def test_a_policy_of_a_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    [defined] = [text for text in blocks(PAGES["docs/tutorial.md"], "python") if "Halves" in text]
    asked = "spec.to_mapping()['policy']['_target_'], spec.trial_key"
    cells = [nbformat.v4.new_code_cell(text) for text in (defined, asked)]
    notebook = nbformat.v4.new_notebook(cells=cells)
    place = {"metadata": {"path": str(tmp_path)}}
    done = NotebookClient(notebook, resources=place).execute()
    assert "'__main__.Alternating'" in done.cells[1].outputs[0]["data"]["text/plain"]
