"""The pages of ``docs/`` keep their word: queries answer on both databases, commands run."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from orchestrate.store import Reader
from orchestrate.store.schema import SCHEMA_VERSION, metadata
from orchestrate.store.views import VIEWS
from tests.analysis.synthetic import fill, make_grid

ROOT = Path(__file__).resolve().parents[1]
PAGES = {path.name: path.read_text() for path in sorted((ROOT / "docs").glob("*.md"))}
QUERIES = re.findall(r"```sql\n-- (.*?)\n(.*?)```", PAGES["database.md"], flags=re.DOTALL)
EMPTY = {
    "which trials were run more than once, and what ended the other attempts?",
    "what failed, and why?",
}
LINKS = [
    (page, link.split("#")[0])
    for page, text in PAGES.items()
    for link in re.findall(r"\]\(([^)]+)\)", text)
    if "://" not in link and link.split("#")[0]
]


@pytest.fixture(params=["sqlite", "postgresql"])
def filled(request: pytest.FixtureRequest) -> str:
    """Return a small grid in a database of each kind."""
    url = str(request.getfixturevalue(f"{request.param}_url"))
    short = {"env": {"horizon": 40}}
    task = {"task": {"name": "control", "checkpoints": [20]}}
    fill(url, make_grid(("pendulum", "cartpole"), seeds=range(8), **short))
    fill(url, make_grid(("pendulum",), ("random",), seeds=range(8), **short, **task))
    return url


def test_there_are_eleven_queries() -> None:
    assert len(QUERIES) == 11


def test_every_query_answers_on_both_databases(filled: str) -> None:
    with Reader.open(filled) as reader:
        for question, query in QUERIES:
            assert reader.query(query) or question in EMPTY, question


def test_every_table_and_view_is_described() -> None:
    page = PAGES["database.md"]
    for name in (*metadata.tables, *VIEWS):
        assert f"`{name}`" in page or name == "alembic_version", name
    assert f"The schema is version {SCHEMA_VERSION}." in page


@pytest.mark.parametrize(("page", "link"), LINKS)
def test_every_link_leads_to_a_file(page: str, link: str) -> None:
    assert (ROOT / "docs" / link).exists(), page


TUTORIAL = [
    line.strip()
    for line in PAGES["tutorial.md"].splitlines()
    if re.match(r"    (PYTHON|python )", line)
]
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGES["tutorial.md"], flags=re.DOTALL)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_the_tutorial_runs_from_its_first_command_to_its_last(tmp_path: Path) -> None:
    """In a folder that looks like the repository, so that nothing is left in the real one."""
    for name in ("analysis", "dopt", "docs", "orchestrate"):
        (tmp_path / name).symlink_to(ROOT / name)
    assert len(TUTORIAL) >= 15
    for command in TUTORIAL:
        if "serve" not in command:  # which does not end; its own tests start it
            _run_in(tmp_path, command)
    for snippet in SNIPPETS:
        _run_in(tmp_path, f"python -c {shlex.quote(snippet)}")
    written = {str(path.relative_to(tmp_path)) for path in (tmp_path / "figures").rglob("*.*")}
    assert {
        "figures/README.md",
        "figures/figure1.pdf",
        "figures/comparison.tex",
        "figures/robust/figure1.png",
        "figures/pendulum_d_optimal.gif",
    } <= written


def _run_in(folder: Path, command: str) -> None:
    words = shlex.split(command)
    given = [word for word in words if re.match(r"[A-Z_]+=", word)]
    path = os.pathsep.join([str(ROOT), *(word.partition("=")[2] for word in given)])
    done = subprocess.run(
        [sys.executable, *words[len(given) + 1 :]],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    assert done.stdout, command


def test_the_notebook_is_executed_and_runs_again(
    sqlite_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    notebook = nbformat.read(ROOT / "docs" / "explore.ipynb", as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert sum("image/png" in str(cell.outputs) for cell in cells) >= 3
    specs = make_grid(("pendulum", "cartpole"), ("d_optimal", "random"), range(6))
    fill(sqlite_url, specs)
    monkeypatch.setenv("DOPT_DB", sqlite_url)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    client = NotebookClient(notebook, timeout=200, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()  # raises what a cell raises
