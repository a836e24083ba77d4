from __future__ import annotations

import csv
import io
import re
import subprocess
import sys
from pathlib import Path

import pytest

from analysis.cli import main, parser
from tests.analysis.conftest import SHORT
from tests.analysis.synthetic import fill, make_grid
from tests.paths import ROOT


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
    assert [row["policy"] for row in rows] == [
        "d_optimal",
        "oracle",
        "uniform",
        "periodic",
        "random",
    ]


def test_compare_prints_every_variant(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "--db", url, "--format", "csv", "--column", "reachable_loss"]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert len(rows) == 11
    assert all(0 <= float(row["p_adjusted"]) <= 1 for row in rows)


def test_the_database_may_come_from_the_environment(
    url: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOPT_DB", url)
    assert main(["summary"]) == 0
    assert "D-optimal" in capsys.readouterr().out


def test_a_path_in_the_variable_is_answered_with_the_variable_and_the_url(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOPT_DB", "mine/x.db")
    assert main(["summary"]) == 2
    error = capsys.readouterr().err
    assert "environment variable DOPT_DB" in error
    assert "write it as sqlite:///mine/x.db." in error


def test_missing_trials_are_refused_with_a_table(
    partial: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["figures", "--db", partial, "--out", str(tmp_path)]) == 3
    error = capsys.readouterr().err
    assert "| pendulum | d_optimal | 2         | 2 pending | 1-2     |" in error
    assert "2 trials are missing" in error
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
        (["--env", "submarine"], "no trial of environment 'submarine'"),
        (["--where", "model.width"], "is no condition, PATH=VALUE is expected"),
        (["--where", "model.width=9"], "fits no stored configuration"),
        (["--where", "modle.width=9"], "names no value"),
    ],
)
def test_a_wrong_request_is_one_sentence(
    url: str, capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert main(["summary", "--db", url, *arguments]) == 2
    captured = capsys.readouterr()
    assert sentence in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["sumary"], "command 'sumary' is unknown.* did you mean 'summary'"),
        ([], "arguments are required: COMMAND: see python -m analysis --help"),
        (["figures", "--only", "figur1"], "--only 'figur1' is unknown.* did you mean 'figure1'"),
        (["summary", "--formt", "csv"], "'--formt' is unknown.* did you mean '--format'"),
        (["summary", "--format", "cvs"], "--format 'cvs' is unknown.* did you mean 'csv'"),
        (["summary", "--db"], "--db: expected one argument: see python -m analysis summary --help"),
        (["figures", "--workers", "0"], "--workers is 0, but at least 1 is expected"),
        (["figures", "--workers", "two"], "--workers is two, but at least 1 is expected"),
        (["floor", "--env", "arm"], "'analysis floor' was removed: .*dopt.fit_offline"),
        (["yardsticks"], "'analysis yardsticks' was removed: python -m studies.yardsticks"),
        (["summary", "more"], "unexpected argument 'more'"),
    ],
)
def test_wrong_words_are_one_sentence(
    capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert re.fullmatch(f"error: .*{sentence}.*[.?]\n", captured.err), captured.err
    assert captured.out == ""


@pytest.mark.parametrize("command", ["calibration", "figures", "summary"])
def test_help_shows_a_percent_sign_once(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    shown = capsys.readouterr().out
    assert "%%" not in shown
    assert "--where PATH=VALUE" in shown


def test_a_reader_that_closes_the_output_ends_the_command(url: str) -> None:
    command = [sys.executable, "-m", "analysis", "summary", "--db", url]
    with subprocess.Popen(
        command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert "rror" not in process.stderr.read()
    assert process.returncode == 0


def test_no_database_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["summary", "--db", f"sqlite:///{tmp_path}/none.db"]) == 2
    assert capsys.readouterr().err.startswith("error: ")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_one_sentence(
    url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["figures", "--db", url, "--out", str(tmp_path / "file" / "figures")]) == 2
    assert "choose another --out" in capsys.readouterr().err
