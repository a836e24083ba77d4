"""The notebook of ``docs/`` was executed, and runs again from wherever it is opened."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.analysis.synthetic import fill, make_grid
from tests.paths import ROOT

NOTEBOOK = nbformat.read(ROOT / "docs" / "explore.ipynb", as_version=4)


def test_it_is_executed() -> None:
    cells = [cell for cell in NOTEBOOK.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert sum("image/png" in str(cell.outputs) for cell in cells) >= 3


@pytest.mark.parametrize("opened_in", ["docs", "."])
def test_it_runs_on_two_configs_of_a_policy(
    opened_in: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the root of a repository and in its docs; the other configuration has as many trials."""
    url = f"sqlite:///{tmp_path}/results/results.db"
    (tmp_path / "docs").mkdir()
    for fields in ({"horizon": 40}, {"horizon": 40, "gamma": 3.0}):
        systems = ("pendulum", "cartpole")
        fill(url, make_grid(systems, ("d_optimal", "random"), range(6), env=fields))
    monkeypatch.delenv("DOPT_DB", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    place = {"metadata": {"path": str(tmp_path / opened_in)}}
    client = NotebookClient(nbformat.from_dict(NOTEBOOK), timeout=200, resources=place)
    client.execute()  # raises what a cell raises
