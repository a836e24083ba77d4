"""Files of figures and tables: provenance, and what is written again."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from analysis import outputs
from analysis.data.matching import Filter
from analysis.data.selection import Selection, select
from analysis.errors import AnalysisError
from analysis.figures.input_spectrum import spectrum_plot
from analysis.figures.loss_curves import _title, loss_plot
from analysis.figures.phase_portraits import Portrait, coverage_text, phase_plot
from analysis.outputs import FIGURES, NAMES, Task, build, plots
from analysis.stats.curves import PlotOptions
from orchestrate.store import Reader
from tests.analysis.conftest import limited
from tests.analysis.synthetic import fill
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS


def test_the_commit_is_that_of_the_code_and_not_of_a_folder_around_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as the repository that holds the virtual environment of an installed copy."""
    package = tmp_path / "venv" / "analysis"
    package.mkdir(parents=True)
    git = ("git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b")
    subprocess.run([*git, "init", "--quiet"], check=True)
    subprocess.run([*git, "commit", "--quiet", "--allow-empty", "--message", "x"], check=True)
    monkeypatch.setattr(outputs, "PACKAGE", package)
    state = outputs.git_state.__wrapped__
    monkeypatch.delenv("DOPT_COMMIT", raising=False)
    assert state() == {"commit": None, "dirty": None}
    monkeypatch.setenv("DOPT_COMMIT", "abc")
    assert state() == {"commit": "abc", "dirty": None}
    monkeypatch.setattr(outputs, "PACKAGE", tmp_path / "analysis")
    (tmp_path / "analysis").mkdir()
    found = state()
    assert re.fullmatch(r"[0-9a-f]{40}", str(found["commit"]))
    assert found["dirty"] is False


QUICK = ("figure2_spectrum", "comparison")


pytestmark = pytest.mark.xdist_group("figures")  # all outputs are drawn once for all of them


@pytest.fixture(scope="module")
def folder(url: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All outputs of the complete grid and of trials with limits, made once."""
    target = tmp_path_factory.mktemp("figures")
    whole = shutil.copy(url.removeprefix("sqlite:///"), tmp_path_factory.mktemp("whole"))
    fill(f"sqlite:///{whole}", limited(("d_optimal",), range(5)))
    with Reader.open(f"sqlite:///{whole}") as reader:
        outcomes = list(build(reader, select(reader, Filter()), PlotOptions(), target))
    assert [(outcome.name, outcome.state) for outcome in outcomes] == [
        (name, "written") for name in (*NAMES, "README.md")
    ]
    return target


def make(reader: Reader, selection: Selection, target: Path, **options: int) -> list[str]:
    return [
        outcome.state
        for outcome in build(reader, selection, PlotOptions(), target, QUICK, **options)
        if outcome.name in QUICK
    ]


def test_the_names_are_those_of_the_registry() -> None:
    assert tuple(plots()) == FIGURES


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_comes_whole(folder: Path, name: str) -> None:
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (folder / f"{name}.svg").read_bytes()
    assert len((folder / f"{name}.txt").read_text()) > 100
    with (folder / f"{name}.csv").open() as file:
        assert len(list(csv.DictReader(file))) >= 5
    facts = json.loads((folder / f"{name}.json").read_text())
    assert facts["statistic"]
    assert facts["band"]
    assert all(config["n_finished"] == 5 for config in facts["cells"])
    assert not list(folder.glob(".*"))


def test_the_page_shows_every_output_and_links_to_files_that_exist(folder: Path) -> None:
    page = (folder / "README.md").read_text()
    links = re.findall(r"\]\(([^)]+)\)", page)
    assert set(NAMES) <= {Path(link).stem for link in links}
    assert all((folder / link).is_file() for link in links)
    for name in plots():
        assert (folder / f"{name}.txt").read_text().strip() in page
    assert "| d_optimal |" not in page.split("## Loss curves")[1]  # tables come first


@pytest.mark.parametrize("name", FIGURES)
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


def test_a_line_that_cannot_be_is_explained(folder: Path) -> None:
    words = (folder / "figure1.txt").read_text()
    assert "No line: policy 'periodic' needs an eigenmode, but env 'quadrotor'" in words
    assert words.count("No line:") == 1
    assert "no periodic" in (folder / "figure1.svg").read_text()


def test_all_portraits_have_the_same_axes(reader: Reader) -> None:
    plot = phase_plot("pendulum")
    panels = plot.make(reader, plot.part(select(reader, Filter())), PlotOptions()).figure.axes[:5]
    assert len({(*axes.get_xlim(), *axes.get_ylim()) for axes in panels}) == 1


def test_a_long_title_is_broken_between_counts() -> None:
    counts = "(n = 4; D-optimal: 3/4, 1 diverged; random: 0/4, 4 diverged)"
    lines = _title("arm", counts).split("\n")
    assert lines[0] == "arm"
    assert [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines[1:]] == [
        "(n = 4; D-optimal: 3/4, 1 diverged;",
        "random: 0/4, 4 diverged)",
    ]


def test_a_caption_names_only_what_is_drawn(reader: Reader) -> None:
    alone = select(reader, Filter(("cartpole",), ("d_optimal",)))
    curves, spectrum = loss_plot("figure1", "loss"), spectrum_plot("cartpole", "spectrum")
    assert "slanted strokes" not in curves.make(reader, alone, PlotOptions()).caption
    assert "in grey" not in spectrum.make(reader, alone, PlotOptions()).caption
    grey = select(reader, Filter(("cartpole",), ("d_optimal", "random")))
    assert "; random in grey;" in spectrum.make(reader, grey, PlotOptions()).caption


@pytest.mark.parametrize(
    ("coverage", "error", "n", "words"),
    [
        (0.1234, 0.00021, 100, "coverage 12.340 ± 0.042 %"),
        (0.5, 0.02, 9, "coverage 50.0 ± 4.0 %"),
        (0.125, float("nan"), 1, "coverage 12.5 %"),
        (float("nan"), float("nan"), 0, "coverage unknown"),
    ],
)
def test_a_coverage_has_the_digits_of_its_error(
    coverage: float, error: float, n: int, words: str
) -> None:
    nowhere = np.empty((0, 2))
    portrait = Portrait("random", nowhere, np.zeros(2), False, coverage, error, n, 0)
    assert coverage_text(portrait) == words


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
    assert len(files) == 6 + 4 + 1
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    pdf = (tmp_path / "a" / "figure2_spectrum.pdf").read_bytes()
    assert (b"/CreationDate (D:20231114" in pdf) == bool(epoch)


def test_several_processes_write_the_same_bytes(reader: Reader, tmp_path: Path) -> None:
    selection = select(reader, Filter())
    make(reader, selection, tmp_path / "one")
    states = make(reader, selection, tmp_path / "two", workers=2)
    assert states == ["written", "written"]
    names = {path.name for path in (tmp_path / "one").iterdir()}
    assert names == {path.name for path in (tmp_path / "two").iterdir()}
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def kill_itself(_: Reader, task: Task) -> None:
    if task.name == QUICK[1]:
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_is_killed_is_said(
    reader: Reader, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outputs, "_write_output", kill_itself)
    with pytest.raises(AnalysisError, match=r"was killed before .* was written, .* --workers 1"):
        make(reader, select(reader, Filter()), tmp_path, workers=2)


def test_an_interruption_ends_all_processes(url: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "analysis", "figures", "--db", url, "--out", str(tmp_path)]
    with subprocess.Popen(
        [*command, "--workers", "2"],
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()  # the first output has been written, and others are being
        os.killpg(process.pid, signal.SIGINT)
        said, errors = process.communicate(timeout=PATIENCE_SECONDS)
    assert process.returncode == 130, errors
    assert "Traceback" not in said + errors
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)


def write_nothing(*_: object) -> None: ...


def write_many(reader: Reader, interruption: threading.Timer) -> None:
    """Write many tasks in two processes, with an interruption in the midst of them."""
    tasks = {str(number): number for number in range(100)}
    with outputs.written(write_nothing, reader, tasks, 2) as wait:
        interruption.start()
        try:
            for name in tasks:
                wait(name)
        finally:
            interruption.join()  # not in the next test


def test_an_interruption_comes_whole_at_any_moment(reader: Reader) -> None:
    """Ctrl-C within a wait for a result must not leave a lock of the pool in disorder."""
    for delay in np.random.default_rng(0).uniform(0, 0.02, size=30):
        interruption = threading.Timer(delay, os.kill, (os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            write_many(reader, interruption)


def test_what_is_unchanged_is_not_drawn_again(reader: Reader, tmp_path: Path) -> None:
    selection = select(reader, Filter())
    assert make(reader, selection, tmp_path) == ["written", "written"]
    assert make(reader, selection, tmp_path) == ["unchanged", "unchanged"]
    assert make(reader, selection, tmp_path, force=True) == ["written", "written"]
    (tmp_path / "figure2_spectrum.png").unlink()
    (tmp_path / "comparison.json").write_text("{ cut off")
    assert make(reader, selection, tmp_path) == ["written", "written"]
    assert make(reader, selection.only(["cartpole"]), tmp_path) == ["unchanged", "written"]


def test_what_is_drawn_by_changed_code_is_drawn_again(
    reader: Reader, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    selection = select(reader, Filter())
    copied = tmp_path / "analysis"
    shutil.copytree(outputs.PACKAGE, copied, ignore=shutil.ignore_patterns("*.pyc"))
    monkeypatch.setattr(outputs, "PACKAGE", copied)
    assert make(reader, selection, tmp_path / "out") == ["written", "written"]
    assert make(reader, selection, tmp_path / "out") == ["unchanged", "unchanged"]
    drawing = copied / "figures" / "input_spectrum.py"
    drawing.write_text(drawing.read_text() + "# changed\n")
    assert make(reader, selection, tmp_path / "out") == ["written", "written"]


def test_steps_to_a_given_loss_need_no_random_inputs(reader: Reader, tmp_path: Path) -> None:
    pair = select(reader, Filter(("pendulum",), ("d_optimal", "uniform")))
    for request, state in ((PlotOptions(), "not drawn"), (PlotOptions(epsilon=1.0), "written")):
        outcome, *_ = build(reader, pair, request, tmp_path, ("comparison_steps",))
        assert outcome.state.startswith(state)


def test_what_has_no_trials_is_said(reader: Reader, tmp_path: Path) -> None:
    part = select(reader, Filter(("quadrotor",)))
    states = {
        outcome.name: outcome.state
        for outcome in build(reader, part, PlotOptions(), tmp_path, QUICK)
    }
    assert states["figure2_spectrum"].startswith("not drawn")
    assert states["comparison"] == "written"
    assert not list(tmp_path.glob("figure2_spectrum*"))


def test_neither_torch_nor_ray_is_needed() -> None:
    code = "import sys, analysis.cli; sys.exit(bool({'torch', 'ray', 'hydra'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


"""Figures and tables of curves, states, inputs, assessments, limits and final losses, as PNG: that
the other formats show the same is tested where they are written.
"""


"""Those of the tables of steps, of trajectories and of trials, which are stored otherwise there."""
