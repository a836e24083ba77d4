"""The files that come out: complete, the same bytes each time, and not made twice."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import pytest

from analysis.choice import Filter
from analysis.figures.plot import Request
from analysis.figures.registry import NAMES, PLOTS, build
from analysis.selection import Selection, select
from orchestrate.store import Reader

QUICK = ("figure2_spectrum", "comparison")


@pytest.fixture(scope="module")
def folder(url: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All outputs of the complete grid, made once."""
    target = tmp_path_factory.mktemp("figures")
    with Reader.open(url) as reader:
        outcomes = list(build(reader, select(reader, Filter()), Request(), target))
    assert [(outcome.name, outcome.state) for outcome in outcomes] == [
        (name, "written") for name in NAMES
    ]
    return target


def make(reader: Reader, selection: Selection, target: Path, **options: bool) -> list[str]:
    return [
        outcome.state for outcome in build(reader, selection, Request(), target, QUICK, **options)
    ]


@pytest.mark.parametrize("name", PLOTS)
def test_every_figure_comes_whole(folder: Path, name: str) -> None:
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (folder / f"{name}.svg").read_bytes()
    assert len((folder / f"{name}.txt").read_text()) > 100
    with (folder / f"{name}.csv").open() as file:
        assert len(list(csv.DictReader(file))) >= 5
    facts = json.loads((folder / f"{name}.json").read_text())
    assert facts["statistic"]
    assert facts["band"]
    assert all(cell["n_finished"] == 5 for cell in facts["cells"])
    assert not list(folder.glob(".*"))


@pytest.mark.parametrize("name", PLOTS)
def test_fonts_are_embedded_as_type_42(folder: Path, name: str) -> None:
    content = (folder / f"{name}.pdf").read_bytes()
    assert b"/FontFile2" in content
    assert b"/Type3" not in content


def test_the_picture_knows_where_it_comes_from(folder: Path) -> None:
    mark = json.loads((folder / "figure1.json").read_text())["fingerprint"].encode()
    for ending in ("png", "svg", "pdf"):
        assert mark in (folder / f"figure1.{ending}").read_bytes()


def test_captions_name_the_band_and_the_counts(folder: Path) -> None:
    caption = (folder / "figure1.txt").read_text()
    assert "95 % t-interval of the mean" in caption
    assert "cartpole n = 5; random: 4/5, 1 diverged" in caption
    assert "final loss is the median" in (folder / "figure2_phase_pendulum.txt").read_text()


@pytest.mark.parametrize("epoch", [None, "1700000000"])
def test_bytes_are_the_same_each_time(
    reader: Reader, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, epoch: str | None
) -> None:
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    if epoch:
        monkeypatch.setenv("SOURCE_DATE_EPOCH", epoch)
    selection = select(reader, Filter())
    for target in ("a", "b"):
        make(reader, selection, tmp_path / target)
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert len(files) == 6 + 3
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    pdf = (tmp_path / "a" / "figure2_spectrum.pdf").read_bytes()
    assert (b"/CreationDate (D:20231114" in pdf) == bool(epoch)


def test_what_is_unchanged_is_not_drawn_again(reader: Reader, tmp_path: Path) -> None:
    selection = select(reader, Filter())
    assert make(reader, selection, tmp_path) == ["written", "written"]
    assert make(reader, selection, tmp_path) == ["unchanged", "unchanged"]
    assert make(reader, selection, tmp_path, force=True) == ["written", "written"]
    (tmp_path / "figure2_spectrum.png").unlink()
    (tmp_path / "comparison.json").write_text("{ cut off")
    assert make(reader, selection, tmp_path) == ["written", "written"]
    assert make(reader, selection.only(["cartpole"]), tmp_path) == ["unchanged", "written"]


def test_what_has_no_trials_is_said(reader: Reader, tmp_path: Path) -> None:
    part = select(reader, Filter(("quadrotor",)))
    states = {
        outcome.name: outcome.state for outcome in build(reader, part, Request(), tmp_path, QUICK)
    }
    assert states["figure2_spectrum"].startswith("not drawn")
    assert states["comparison"] == "written"
    assert not list(tmp_path.glob("figure2_spectrum*"))


def test_neither_torch_nor_ray_is_needed() -> None:
    code = "import sys, analysis.cli; sys.exit(bool({'torch', 'ray', 'hydra'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
