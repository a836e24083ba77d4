"""The notebooks of ``docs/`` were executed, and run again from wherever they are opened."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import pytest
from nbclient import NotebookClient

from tests.analysis.synthetic import fill, make_grid
from tests.pages import PAGES, blocks
from tests.paths import ROOT

NOTEBOOK, PLANT = (
    nbformat.read(ROOT / "docs" / name, as_version=4) for name in ("explore.ipynb", "plant.ipynb")
)


@pytest.mark.parametrize(("notebook", "pictures"), [(NOTEBOOK, 3), (PLANT, 2)])
def test_it_is_executed(notebook: nbformat.NotebookNode, pictures: int) -> None:
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


def test_it_runs_in_docs(root: Path) -> None:
    place = {"metadata": {"path": str(root / "docs")}}
    client = NotebookClient(nbformat.from_dict(NOTEBOOK), resources=place)
    client.execute()  # raises what a cell raises


def test_its_cells_run_in_the_root(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
