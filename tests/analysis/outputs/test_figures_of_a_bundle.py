"""Figures of a bundle alone: the same bytes as those of the database that it was exported from."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from analysis import cli
from analysis.outputs import publish
from orchestrate import __main__ as orchestrate
from orchestrate.store.bundles import cached
from tests.analysis.conftest import controlled, limited
from tests.analysis.synthetic import fill, make_grid

DRAWN = (
    *("figure1", "figure2_phase_cartpole", "figure2_spectrum", "figure5_control"),
    *("figure9_limits", "comparison", "summary"),
)
"""Figures and tables of curves, states, inputs, assessments, limits and final losses, as PNG: that
the other formats show the same is tested where they are written.
"""

PNG = ("png",)

FEW = ("figure1", "figure2_spectrum", "summary")
"""Those of the tables of steps, of trajectories and of trials, which are stored otherwise there."""


@pytest.fixture
def source(request: pytest.FixtureRequest) -> str:
    """Return a grid in a database of the kind that the test names, with a diverged trial."""
    url = str(request.getfixturevalue(f"{request.param}_url"))
    grid = make_grid(seeds=range(3))
    fill(url, grid, diverged={grid[1].trial_key: 100})
    fill(url, controlled(range(3)))
    fill(url, limited(("d_optimal",), range(3)))
    return url


def draw(url: str, folder: Path, names: tuple[str, ...]) -> dict[str, bytes]:
    """Return the pictures and tables by name."""
    only = [word for name in names for word in ("--only", name)]
    assert cli.main(["figures", "--db", url, "--out", str(folder), *only]) == 0
    endings = {f".{ending}" for ending in (*publish.PICTURES, "csv", "md", "tex")}
    return {
        path.name: path.read_bytes()
        for path in folder.iterdir()
        if path.suffix in endings and path.name != "README.md"  # which names the database
    }


@pytest.mark.parametrize("source", ["sqlite", "postgresql"], indirect=True)
def test_they_are_the_same_bytes(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cached, "copies_folder", lambda: tmp_path)
    bundle = tmp_path / "bundle"
    assert orchestrate.main(["export", "bundle", str(bundle), "--db", source]) == 0
    names = DRAWN if source.startswith("sqlite") else FEW
    if names == DRAWN:
        monkeypatch.setattr(publish, "PICTURES", PNG)
    expected = draw(source, tmp_path / "of_database", names)
    if source.startswith("sqlite"):
        shutil.rmtree(Path(source.removeprefix("sqlite:///")).parent)
    found = draw(f"bundle:///{bundle}", tmp_path / "of_bundle", names)
    assert {Path(name).suffix for name in found} >= {f".{ending}" for ending in publish.PICTURES}
    n_figures = sum(name.startswith("figure") for name in names)
    n_tables = len(names) - n_figures  # each as CSV, Markdown and LaTeX
    assert len(found) == (len(publish.PICTURES) + 1) * n_figures + 3 * n_tables
    assert found.keys() == expected.keys()
    for name, content in expected.items():
        assert found[name] == content, name
    about = json.loads((tmp_path / "of_bundle" / "figure1.json").read_text())
    assert about["database"] == f"bundle:///{bundle}"
