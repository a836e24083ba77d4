"""Files of ``analysis figures``, the command line, and an analysis without the browser."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
from pathlib import Path

import pytest

from analysis import outputs
from analysis.cli import main, parser
from analysis.data.matching import Filter
from analysis.data.selection import Selection, select
from analysis.figures.losses import _title, loss_plot
from analysis.figures.phase_portraits import phase_plot, spectrum_plot
from analysis.outputs import FIGURES, NAMES, build, plots
from analysis.stats.curves import PlotOptions
from orchestrate.store import Reader
from tests.analysis.conftest import SHORT, limited
from tests.analysis.synthetic import fill, make_grid
from tests.orchestrate.runner.test_records import commit, git
from tests.paths import ROOT


def test_the_state_of_the_code_is_that_of_its_own_repository(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outputs, "PACKAGE", tmp_path / "analysis")
    state = outputs.git_state.__wrapped__
    for image in ("", "abc"):
        monkeypatch.setenv("DOPT_COMMIT", image)
        assert state() == {"commit": image or None, "dirty": None}
    commit(tmp_path, "code.py")
    assert state() == {"commit": git(tmp_path, "rev-parse", "HEAD"), "dirty": False}
    (tmp_path / "code.py").write_text("a = 2\n")
    assert state()["dirty"] is True


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
    assert outcomes == [(name, "written") for name in (*NAMES, "README.md")]
    return target


def make(reader: Reader, selection: Selection, target: Path, **options: int) -> list[str]:
    return [
        state
        for name, state in build(reader, selection, PlotOptions(), target, QUICK, **options)
        if name in QUICK
    ]


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
    for ending in ("png", "svg", "pdf"):
        assert facts["fingerprint"].encode() in (folder / f"{name}.{ending}").read_bytes()
    content = (folder / f"{name}.pdf").read_bytes()
    assert b"/FontFile2" in content
    assert b"/Type3" not in content
    assert all(config["n_finished"] == 5 for config in facts["cells"])
    assert not list(folder.glob(".*"))


def test_the_page_shows_every_output_and_links_to_files_that_exist(folder: Path) -> None:
    assert tuple(plots()) == FIGURES
    page = (folder / "README.md").read_text()
    links = re.findall(r"\]\(([^)]+)\)", page)
    assert set(NAMES) <= {Path(link).stem for link in links}
    assert all((folder / link).is_file() for link in links)
    for name in plots():
        assert (folder / f"{name}.txt").read_text().strip() in page
    assert "| d_optimal |" not in page.split("## Loss curves")[1]  # tables come first


def test_captions_name_the_band_the_counts_and_why_a_line_cannot_be(folder: Path) -> None:
    caption = (folder / "figure1.txt").read_text()
    assert "95 % t-interval of the mean" in caption
    assert "cartpole n = 5; random: 4/5, 1 diverged" in caption
    assert "final loss is the median" in (folder / "figure2_phase_pendulum.txt").read_text()
    assert "No line: policy 'periodic' needs an eigenmode, but env 'quadrotor'" in caption
    assert caption.count("No line:") == 1
    assert "no periodic" in (folder / "figure1.svg").read_text()


def test_all_portraits_have_the_same_axes(reader: Reader) -> None:
    plot = phase_plot("pendulum")
    panels = plot.make(
        reader, plot.part(select(reader, Filter()), PlotOptions()), PlotOptions()
    ).figure.axes[:5]
    assert len({(*axes.get_xlim(), *axes.get_ylim()) for axes in panels}) == 1


def test_a_long_title_is_broken_between_counts() -> None:
    counts = "(n = 4; D-optimal: 3/4, 1 diverged; random: 0/4, 4 diverged)"
    lines = _title("arm", counts).split("\n")
    assert lines[0] == "arm"
    found = [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines[1:]]
    assert found == ["(n = 4; D-optimal: 3/4, 1 diverged;", "random: 0/4, 4 diverged)"]


def test_a_caption_names_only_what_is_drawn(reader: Reader) -> None:
    alone = select(reader, Filter(("cartpole",), ("d_optimal",)))
    curves, spectrum = loss_plot("loss"), spectrum_plot("cartpole")
    assert "slanted strokes" not in curves.make(reader, alone, PlotOptions()).caption
    assert "in grey" not in spectrum.make(reader, alone, PlotOptions()).caption
    grey = select(reader, Filter(("cartpole",), ("d_optimal", "random")))
    assert "; random in grey;" in spectrum.make(reader, grey, PlotOptions()).caption


def test_what_is_drawn_twice_has_the_same_bytes(
    reader: Reader, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    selection = select(reader, Filter())
    for target in ("one", "two"):
        assert make(reader, selection, tmp_path / target) == ["written"] * 2
    files = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert len(files) == 6 + 4 + 1
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    assert b"/CreationDate" not in (tmp_path / "one" / "figure2_spectrum.pdf").read_bytes()
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    list(build(reader, selection, PlotOptions(), tmp_path / "dated", QUICK[:1]))
    dated = (tmp_path / "dated" / "figure2_spectrum.pdf").read_bytes()
    assert b"/CreationDate (D:20231114" in dated


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
    drawing = copied / "figures" / "phase_portraits.py"
    drawing.write_text(drawing.read_text() + "# changed\n")
    assert make(reader, selection, tmp_path / "out") == ["written", "written"]


def test_steps_to_a_given_loss_need_no_random_inputs(reader: Reader, tmp_path: Path) -> None:
    pair = select(reader, Filter(("pendulum",), ("d_optimal", "uniform")))
    for request, state in ((PlotOptions(), "not drawn"), (PlotOptions(epsilon=1.0), "written")):
        (_, made), *_ = build(reader, pair, request, tmp_path, ("comparison_steps",))
        assert made.startswith(state)


def test_what_has_no_trials_is_said(reader: Reader, tmp_path: Path) -> None:
    part = select(reader, Filter(("quadrotor",)))
    states = dict(build(reader, part, PlotOptions(), tmp_path, QUICK))
    assert states["figure2_spectrum"].startswith("not drawn")
    assert states["comparison"] == "written"
    assert not list(tmp_path.glob("figure2_spectrum*"))


@pytest.fixture(scope="module")
def partial(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a grid that stopped in the middle; every random trial that ran diverged."""
    address = f"sqlite:///{tmp_path_factory.mktemp('partial')}/results.db"
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(4), **SHORT)
    lost = {spec.trial_key: 9 for spec in specs if spec.policy.name == "random"}
    fill(address, specs, skipped=specs[1:3], diverged=lost)
    return address


def test_what_a_command_writes_by_default_is_ignored_by_git() -> None:
    """Otherwise later launches would be marked as run with changes."""
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    for words in (["figures"], ["report"]):
        assert f"/{parser().parse_args(words).out}/" in ignored


def test_summary_prints_markdown_or_csv(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["summary", "--db", url]) == 0
    assert "| cartpole  | random    |" in capsys.readouterr().out
    assert main(["summary", "--db", url, "--format", "csv", "--env", "pendulum"]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    policies = ["d_optimal", "oracle", "uniform", "periodic", "random"]
    assert [row["policy"] for row in rows] == policies


def test_missing_trials_are_refused_with_a_table(
    partial: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["figures", "--db", partial, "--out", str(tmp_path)]) == 3
    error = capsys.readouterr().err
    assert "| pendulum | d_optimal | 2         | 2 pending | 1-2     |" in error
    assert "2 trials missing" in error
    assert not list(tmp_path.iterdir())


def test_partial_figures_are_drawn_and_marked_on_request(
    partial: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    only = ["--only", "figure1", "--only", "summary", "--allow-partial"]
    assert main(["figures", "--db", partial, "--out", str(tmp_path), *only]) == 0
    assert "figure1: written" in capsys.readouterr().out
    for name in ("figure1.txt", "summary.md"):
        assert (tmp_path / name).read_text().startswith("PARTIAL: 2 trials missing.")
    assert (tmp_path / "summary.tex").read_text().startswith("% PARTIAL: 2 trials missing.\n")
    assert b"PARTIAL" not in (tmp_path / "figure1.csv").read_bytes()


def test_an_output_asked_for_by_name_that_has_no_trials_is_a_failure(
    partial: str, tmp_path: Path
) -> None:
    only = ["--only", "figure2_spectrum", "--allow-partial"]
    assert main(["figures", "--db", partial, "--out", str(tmp_path), *only]) == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["summary", "--env", "submarine"], "no trial of environment 'submarine'"),
        (["summary", "--where", "model.width"], "is no condition, PATH=VALUE is expected"),
        (["summary", "--where", "model.width=9"], "fits no stored configuration, .* 4, 8, 16, 32"),
        (["summary", "--where", "modle.width=9"], "names no value"),
        (["sumary"], "command 'sumary' is unknown.* did you mean 'summary'"),
        ([], "arguments are required: COMMAND: see python -m analysis --help"),
        (["figures", "--only", "figur1"], "--only 'figur1' is unknown.* did you mean 'figure1'"),
        (["summary", "--formt", "csv"], "'--formt' is unknown.* did you mean '--format'"),
        (["summary", "--format", "cvs"], "--format 'cvs' is unknown.* did you mean 'csv'"),
        (["summary", "--db"], "--db: expected one argument: see python -m analysis summary --help"),
        (["compare", "--diverged", "worst"], "'analysis --diverged' was removed: analysis.load"),
        (["figures", "--workers", "2"], "'analysis --workers' was removed: one process draws"),
        (["figures", "--only", "comparison_control"], "was removed: python -m analysis report"),
        (["floor", "--env", "arm"], "'analysis floor' was removed: .*dopt.fit_offline"),
        (["yardsticks"], "'analysis yardsticks' was removed: python -m studies.yardsticks"),
        (["summary", "more"], "unexpected argument 'more'"),
        (["summary", "--db", "sqlite:////nowhere/x.db"], "There is no results database"),
    ],
)
def test_wrong_words_are_one_sentence(
    url: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    arguments: list[str], sentence: str,
) -> None:  # fmt: skip
    monkeypatch.setenv("DOPT_DB", url)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert re.fullmatch(f"error: .*{sentence}.*[.?]\n", captured.err), captured.err
    assert captured.out == ""


def test_a_folder_that_cannot_be_made_is_one_sentence(
    url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["figures", "--db", url, "--out", str(tmp_path / "file" / "figures")]) == 2
    assert "choose another --out" in capsys.readouterr().err
