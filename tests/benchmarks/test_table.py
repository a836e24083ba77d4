"""The benchmark runs and prints a table that can be read; how fast anything is, is not tested."""

from __future__ import annotations

import importlib
import math
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.cli import HEADERS, QUESTIONS, main, parser
from benchmarks.history import read
from benchmarks.processes import _accounts
from benchmarks.rows import Anchor, Row, Target
from tests.paths import ROOT


def table(text: str) -> list[dict[str, str]]:
    """Return the rows of the table by their headers."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    headers, _, *rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines)
    return [dict(zip(headers, row, strict=True)) for row in rows]


def test_the_step_is_measured_beside_its_targets(tmp_path: Path) -> None:
    history = tmp_path / "history.jsonl"
    command = [sys.executable, "-m", "benchmarks", "--quick", "--only", "step"]
    command += ["--history", str(history)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    rows = table(done.stdout)
    assert tuple(rows[0]) == HEADERS
    assert {row["question"] for row in rows} == {"step"}
    for row in rows[:3]:
        value, unit = row["measured"].split()
        assert unit == "µs"
        assert float(value) > 0
        assert row["target"].startswith("1: ≤ ")
        assert float(row["of target"]) > 0
    assert "machine: " in done.stdout
    assert "numba " in done.stdout
    (run,) = read(history)
    timed, ratios = rows[:4], rows[4:]
    assert [f"step: {row['what']}" for row in timed] == list(run.rows)
    assert [row["measured"].split()[1] for row in ratios] == 2 * ["products"]


def test_a_question_that_fails_is_said_and_the_others_are_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def ask(question: str, quick: bool) -> list[Row]:
        if question == "store":
            raise OSError("the disk is full\nand more")
        return [Row("quick" if quick else "whole", 1.0, "s")]

    monkeypatch.setattr("benchmarks.cli.ask", ask)
    keep = ["--history", str(tmp_path / "history.jsonl")]
    assert main(["--only", "store,step", *keep]) == 1
    first, second = table(capsys.readouterr().out)
    assert first["note"] == "OSError: the disk is full"
    assert (second["what"], second["measured"]) == ("whole", "1 s")
    assert main(["--only", "step", "--quick", *keep]) == 0


def test_a_question_that_does_not_exist_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parser().parse_args(["--only", "step,speed"])
    assert "'speed' is no question, choose of step" in capsys.readouterr().err


@pytest.mark.parametrize("question", QUESTIONS)
def test_every_question_is_a_function_that_says_what_it_measures(question: str) -> None:
    module = importlib.import_module(f"benchmarks.{QUESTIONS[question]}")
    assert getattr(module, question).__doc__.startswith("Return ")


def test_ratios_are_above_one_where_the_target_is_met() -> None:
    at_most, at_least = Target(1, 125.0), Target(4, 300_000.0, at_least=True)
    assert at_most.ratio(100.0) == 1.25
    assert at_least.ratio(150_000.0) == 0.5
    assert at_most.ratio(0.0) == math.inf


def test_a_row_shows_how_many_times_faster_it_is_than_others() -> None:
    row = Row("step", 100.0, "µs", Target(1, 125.0), Anchor(12_600.0, "others"), "note")
    assert row.cells() == ["100 µs", "1: ≤ 125", "1.25", "12,600", "126", "note"]


def test_what_was_left_out_says_why() -> None:
    assert Row("scan", None, note="jax is not installed").cells()[0] == "left out"
    assert Row("scan", None, note="jax is not installed").cells()[-1] == "jax is not installed"


def test_the_rate_of_a_launch_leaves_out_the_first_trial_of_each_worker() -> None:
    first, second = 7, 8
    rows = [(first, 0.0, 5.0, 5.0), (second, 1.0, 7.0, 6.0), (first, 5.0, 6.0, 1.0)]
    rows += [(first, 6.0 + i, 7.0 + i, 1.0) for i in range(4)]
    rows += [(second, 7.0 + i, 8.0 + i, 1.0) for i in range(3)]
    found = _accounts(rows)
    assert (found.span, found.work) == (10.0, 19.0)
    assert found.rate == pytest.approx(2.0)
