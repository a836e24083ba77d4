"""Benchmarks: their table, their history, and trials that are equal bit by bit."""

from __future__ import annotations

import importlib
import math
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from benchmarks import bit_equality, cli, gpu, history, kernel
from benchmarks.cli import HEADERS, QUESTIONS, main, parser
from benchmarks.history import FEWEST, Run, append, costs, read, slower
from benchmarks.processes import _accounts
from benchmarks.rows import Anchor, Row, Target, Timing
from benchmarks.trials import CYCLE, cost, step_us
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
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


def test_a_row_shows_how_many_times_faster_it_is_than_others_or_why_it_was_left_out() -> None:
    row = Row("step", 100.0, "µs", Target(1, 125.0), Anchor(12_600.0, "others"), "note")
    assert row.cells() == ["100 µs", "1: ≤ 125", "1.25", "12,600", "126", "note"]
    assert Target(4, 300_000.0, at_least=True).ratio(150_000.0) == 0.5
    assert Target(1, 125.0).ratio(0.0) == math.inf
    first, *_, last = Row("scan", None, note="jax is not installed").cells()
    assert (first, last) == ("left out", "jax is not installed")


def test_the_rate_of_a_launch_leaves_out_the_first_trial_of_each_worker() -> None:
    first, second = 7, 8
    rows = [(first, 0.0, 5.0, 5.0), (second, 1.0, 7.0, 6.0), (first, 5.0, 6.0, 1.0)]
    rows += [(first, 6.0 + i, 7.0 + i, 1.0) for i in range(4)]
    rows += [(second, 7.0 + i, 8.0 + i, 1.0) for i in range(3)]
    found = _accounts(rows)
    assert (found.span, found.work) == (10.0, 19.0)
    assert found.rate == pytest.approx(2.0)


def run(
    value: float, unit_seconds: float = 0.01, unit: str = "µs", processor: str = "usual"
) -> Run:
    made = Run("2026-01-01T00:00:00+00:00", "abc", "a machine", processor)
    made.add("step", [Row("D-optimal", value, unit)], unit_seconds)
    return made


@pytest.fixture
def past(tmp_path: Path) -> Path:
    """Return a history in which a step took 100, 102 and 98 µs."""
    path = tmp_path / "past.jsonl"
    for value in (100.0, 102.0, 98.0):
        append(path, run(value))
    return path


def test_a_history_is_read_as_it_was_written(tmp_path: Path) -> None:
    runs = [run(100.0), run(3.0, unit="rows/s")]
    runs[0].add("width", [Row("share", 5.0, "%"), Row("scan", None, note="no jax")], 0.01)
    assert list(runs[0].rows) == ["step: D-optimal"], "what is no time is left out"
    for each in runs:
        append(tmp_path / "new" / "history.jsonl", each)
    assert read(tmp_path / "new" / "history.jsonl") == runs


def test_a_line_that_is_no_run_is_named(past: Path) -> None:
    with past.open("a") as file:
        file.write('{"rows": {}}\n')
    with pytest.raises(ValueError, match=r"^line 4 of .*past.jsonl is no run of the benchmarks"):
        read(past)


@pytest.mark.parametrize(
    ("value", "unit_seconds", "slow"),
    [
        (119.0, 0.01, False),
        (121.0, 0.01, True),
        (50.0, 0.01, False),
        (200.0, 0.02, False),  # of a machine that is slow in all
        (100.0, 0.005, True),
    ],
)
def test_a_row_is_slower_at_a_fifth_more_than_the_median(
    past: Path, value: float, unit_seconds: float, slow: bool
) -> None:
    assert bool(slower(read(past), run(value, unit_seconds))) is slow


def test_a_rate_is_slower_when_it_falls() -> None:
    runs = [run(value, unit="rows/s") for value in (100.0, 102.0, 98.0)]
    assert not slower(runs, run(200.0, unit="rows/s"))
    (found,) = slower(runs, run(50.0, unit="rows/s"))
    assert str(found) == "step: D-optimal: 2.00 times the median of 3 runs"


def test_a_run_is_compared_with_those_on_its_kind_of_processor(past: Path) -> None:
    runs = read(past)
    assert not slower(runs[:2], run(1000.0)), "two runs are no median"
    assert not slower(runs, run(170.0, processor="other"))
    (found,) = slower(runs, run(210.0, processor="other"))
    assert str(found) == "step: D-optimal: 2.10 times the median of 3 runs on all processors"
    runs += [run(170.0, processor="other")] * FEWEST
    assert not slower(runs, run(200.0, processor="other"))
    assert slower(runs, run(210.0, processor="other"))
    assert slower(runs, run(121.0))


def test_a_slower_row_is_measured_again_and_its_quickest_time_counts(
    past: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command fails where none of its times is quick enough."""
    monkeypatch.setattr(cli, "fixed_seconds", lambda: 0.01)
    monkeypatch.setattr(history, "processor", lambda: "usual")
    kept = tmp_path / "history.jsonl"
    arguments = ["--only", "step", "--history", str(kept), "--against", str(past)]
    slow = [170.0, 150.0, 130.0, 101.0]
    for values, status in (([101.0], 0), ([*slow[:2], 101.0], 0), (slow, 1)):
        times = iter(values)
        monkeypatch.setattr(kernel, "step", lambda _, t=times: [Row("D-optimal", next(t), "µs")])
        assert main(arguments) == status
    assert [run.rows["step: D-optimal"].value for run in read(kept)] == [101.0, 101.0, 130.0]
    assert "slower: step: D-optimal: 1.30 times the median of 3 runs" in capsys.readouterr().out


def result_of(microseconds: np.ndarray) -> TrialResult:
    """Return what the benchmarks read of a trial: the times of its steps."""
    return cast("TrialResult", SimpleNamespace(plan_us=microseconds, learn_us=np.zeros(500)))


def steps(rng: np.random.Generator, slowdown: float = 1.0) -> np.ndarray:
    """Return noisy times of 500 steps; each eighth also takes the pending rows into M⁻¹."""
    quiet = np.where(np.arange(500) % CYCLE == 0, 360.0, 123.0) * slowdown
    return quiet * (1.0 + 0.03 * rng.random(500))


def test_the_mean_of_the_steps_sees_the_eighth_that_the_median_misses() -> None:
    rng = np.random.default_rng(0)
    found = cost([result_of(steps(rng)) for _ in range(4)], step_us)
    assert found.mean == pytest.approx((360 + 7 * 123) / 8, rel=0.05)
    assert found.p99 > 360
    assert np.median(steps(rng)) < 130


@pytest.mark.parametrize(("busy", "slowdown"), [(0.0, 1.3), (0.05, 1.3), (0.2, 1.5)])
def test_a_slower_step_is_found_beside_other_processes(busy: float, slowdown: float) -> None:
    """Other processes take the core for milliseconds, at random moments of every trial."""
    rng = np.random.default_rng(0)

    def measured(slowdown: float) -> Run:
        trials = [steps(rng, slowdown) for _ in range(4)]
        taken = [one + 4_000.0 * (rng.random(500) < busy * rng.random()) for one in trials]
        found = cost([result_of(one) for one in taken], step_us)
        made = Run("2026-01-01T00:00:00+00:00", "abc", "a machine", "usual")
        made.add(
            "step", [Row("s", found.mean, "µs", timing=Timing(found.quickest, "µs", 1.0))], 1.0
        )
        return made

    runs = [measured(1.0) for _ in range(FEWEST)]
    assert not slower(runs, measured(1.0))
    (found,) = slower(runs, measured(slowdown))
    assert found.times == pytest.approx(slowdown, rel=0.05)


def test_a_row_of_a_step_is_what_its_trials_took_to_plan_and_learn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken = SimpleNamespace(plan_us=np.full(500, 100.0), learn_us=np.full(500, 50.0))
    monkeypatch.setattr(kernel, "run_trial", lambda _: taken)
    rows = kernel.step(quick=True)[:4]
    assert [row.value for row in rows] == pytest.approx([150.0] * 4)


def test_the_stored_history_holds_enough_runs_of_what_is_checked() -> None:
    known = costs(read(ROOT / "benchmarks" / "history.jsonl"))
    assert known
    assert all(len(past) >= FEWEST for past in known.values())


TABLES = """
CREATE TABLE trial (trial_id, trial_key, status, n_steps, final_loss, best_loss, diverged_at);
CREATE TABLE step (trial_id, t, loss, reachable_loss, plan_us);
CREATE TABLE trajectory (
    trial_id, dtype, states_shape, states, inputs_shape, inputs, parameters_shape, parameters
);
"""


def database(path: Path, key: str = "a", loss: float = 0.1, states: bytes = b"1") -> str:
    with sqlite3.connect(path) as connection:
        connection.executescript(TABLES)
        connection.execute("INSERT INTO trial VALUES (7, ?, 'done', 1, 0.5, 0.5, NULL)", (key,))
        connection.execute("INSERT INTO step VALUES (7, 0, ?, NULL, ?)", (loss, hash(path)))
        connection.execute(
            "INSERT INTO trajectory VALUES (7, '<f8', '1', ?, '1', x'', '1', x'')", (states,)
        )
    connection.close()
    return str(path)


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({}, ""),  # whatever the times
        ({"loss": 0.1 + 2**-55}, "differs in table step"),
        ({"states": b"2"}, "differs in table trajectory"),
        ({"key": "b"}, "old.db alone"),
    ],
)
def test_a_difference_is_named(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changed: dict[str, float | str | bytes],
    line: str,
) -> None:
    old, new = database(tmp_path / "old.db"), database(tmp_path / "new.db", **changed)  # type: ignore[arg-type]
    assert bit_equality.main([old, new]) == bool(changed)
    assert line in capsys.readouterr().out
    assert bit_equality.main([old]) == 2
    assert "two SQLite databases are expected" in capsys.readouterr().out


# The benchmark of batches on a GPU, on the CPU with small ones


def test_the_cpu_stands_in_for_a_card(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gpu, "SIZES", {"cpu": (2, 3)})
    monkeypatch.setattr(gpu, "COMPARED", 8)
    monkeypatch.setattr(gpu, "speed", _full_at(3))
    assert gpu.main(["--device", "cpu"]) == 0
    out = capsys.readouterr().out
    assert out.count("largest difference of an input: ") == 2
    assert "2 trials on cpu: " in out
    assert "% of the memory's rate" in out
    assert "3 trials on cpu: left out (the memory of the device is too small)" in out
    assert gpu.main(["--device", "cpu", "--seconds", "0"]) == 0
    assert "2 trials on cpu: left out (the time was over" in capsys.readouterr().out


def _full_at(size: int) -> Callable[..., Row]:
    measured = gpu.speed

    def speed(what: str, device: str, trials: int, steps: int, rate: float) -> Row:
        if trials == size:
            raise torch.OutOfMemoryError
        return measured(what, device, trials, steps, rate)

    return speed


def test_a_device_that_is_not_there_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert gpu.main(["--device", "cuda:99"]) == 1
    assert "--device is 'cuda:99', but torch runs here on cpu" in capsys.readouterr().err


def test_an_input_of_another_sign_counts_unless_rounding_decides(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spec = TrialSpec.from_names(env="cartpole", policy="d_optimal", seed=0)
    one = np.ones((1, 6, 1))
    other = one.copy()
    other[0, 4:] = -1.0
    assert gpu.cosine(spec, 4) > gpu.TIE
    assert gpu.largest_difference([spec], one, other) == (2.0, "")
    monkeypatch.setattr(gpu, "TIE", 1.1)
    assert gpu.largest_difference([spec], one, other) == (0.0, ", a tie at step 4 of seed 0")
    monkeypatch.undo()
    other[0, 2] = np.nan
    assert gpu.largest_difference([spec], one, other)[0] == np.inf
