"""Common parts of all commands: words, refusals, exit codes, pipes."""

from __future__ import annotations

import csv
import importlib
import io
import json
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dopt.result import Assessment
from orchestrate.__main__ import COMMANDS, main
from orchestrate.errors import ExitCode
from orchestrate.program import Parser
from orchestrate.store import Store
from tests.orchestrate.commands.conftest import (
    BAD,
    BROKEN,
    DONE,
    RUNNING,
    Answer,
    failure,
    on_both,
    run_now,
)
from tests.orchestrate.store.fakes import HORIZON, LAUNCH, Spec, result, run_all
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS

READING = [
    ["status"],
    ["show", "--seed", "1"],
    ["retry", "failed"],
    ["query", "SELECT 1"],
    ["export", "curves", "--out", "curves.csv"],
]

Capture = pytest.CaptureFixture[str]


def refusal(words: list[str], capsys: Capture) -> tuple[int, str]:
    """Return the exit code and the one line on the standard error."""
    code = main(words)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    return code, err


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"]])
def test_without_a_command_it_lists_them(words: list[str], capsys: Capture) -> None:
    assert main(words) == 0
    out, _ = capsys.readouterr()
    for command in COMMANDS:
        assert f"  {command.name} " in out
        assert command.help in out


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["statsu"], "did you mean 'status'?"),
        (["status", "--evn", "pendulum"], "did you mean '--env'?"),
        (["retry", "faild"], "did you mean 'failed'?"),
        (["retry"], "see python -m orchestrate retry --help"),
        (["status", "more"], "unexpected argument 'more'"),
        (["query", "SELECT 1", "--limit", "0"], "a whole number above 0 is expected"),
        (["query", "SELECT 1", "--timeout", "nan"], "a number above 0 is expected"),
        (["query", "SELECT 1", "--csv", "--json"], "leave one of them out"),
        (["work", "--lease", "1e12"], "'1e12', less than 1,000,000,000 is expected"),
        (["work", "--processes", "1001"], "1,001 processes are asked for"),
        (["status", "--watch"], "'status --watch' was removed: watch python -m orchestrate"),
        (["show", "--seed", "one"], "a whole number from 0 to 2^63 - 1 is expected"),
        (["export", "curves", "--out", "x", "--format", "parket"], "did you mean 'parquet'?"),
        (["export", "curves", "--out", "curves.xlsx"], "give --format"),
        (["status", "--db", "results.db"], "The database URL cannot be read"),
    ],
)
def test_a_bad_request_is_one_sentence(words: list[str], hint: str, capsys: Capture) -> None:
    code, sentence = refusal(words, capsys)
    assert code == ExitCode.BAD_REQUEST
    assert hint in sentence


CHANGING = [
    ["backup", "copy"],
    ["prune", "--yes", "--older-than", "1d"],
    ["upgrade"],
    ["doctor"],
    ["work"],
]


@pytest.mark.parametrize("words", [*READING, *CHANGING], ids=lambda words: words[0])
def test_no_database(
    words: list[str], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, sentence = refusal([*words, "--db", f"sqlite:///{tmp_path}/none.db"], capsys)
    assert code == ExitCode.BAD_REQUEST
    assert "There is no results database" in sentence
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", READING, ids=lambda words: words[0])
class TestOnEveryDatabase:
    def test_no_server(self, words: list[str], capsys: Capture) -> None:
        url = "postgresql://me:hunter2@127.0.0.1:1/db"
        code, sentence = refusal([*words, "--db", url], capsys)
        assert code == ExitCode.INFRASTRUCTURE
        assert "hunter2" not in sentence

    def test_an_empty_database(
        self,
        words: list[str],
        url: str,
        store: Store,  # noqa: ARG002 it creates the database
        capsys: Capture,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.chdir(tmp_path)
        refused = words[0] in ("show", "export")
        assert main([*words, "--db", url]) == (ExitCode.BAD_REQUEST if refused else 0)
        out, err = capsys.readouterr()
        assert (err if refused else out).strip()
        assert not list(tmp_path.glob("curves*"))
        if not refused:
            assert main([*words, "--json", "--db", url]) == 0
            json.loads(capsys.readouterr().out)


def test_the_entry_point_is_the_same_program(monkeypatch: pytest.MonkeyPatch) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    module, _, function = project["scripts"]["dopt"].partition(":")
    packages = {name: one for name, one in sys.modules.items() if name == "orchestrate"}
    started: list[str] = []
    monkeypatch.setattr("orchestrate.program.run", started.append)
    try:
        getattr(importlib.import_module(module), function)()
    finally:
        sys.modules.update(packages)
    assert started == ["orchestrate.__main__"]


def test_an_option_is_not_abbreviated() -> None:
    parser = Parser(prog="x")
    parser.add_argument("--policy")
    assert parser.read(["--policy", "a"]).policy == "a"
    with pytest.raises(Exception, match="did you mean '--policy'"):
        parser.read(["--polic", "a"])


def test_a_reader_that_has_seen_enough_ends_it_quietly(sqlite_url: str) -> None:
    run_all(sqlite_url, *(Spec(seed, horizon=2000) for seed in range(5)))
    program = [sys.executable, "-m", "orchestrate", "query", "SELECT * FROM v_curve", "--csv"]
    running = subprocess.Popen(
        [*program, "--db", sqlite_url], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert running.stdout is not None
    assert running.stderr is not None
    assert running.stdout.readline().startswith(b"config_key")
    running.stdout.close()
    assert running.stderr.read() == b""
    running.stderr.close()
    assert running.wait(timeout=PATIENCE_SECONDS) == 0


Run = Callable[..., Answer]

STEPS = (
    "SELECT t, loss FROM v_curve WHERE env = 'pendulum' AND policy = 'random' AND seed = 0"
    " ORDER BY t"
)


def test_a_table_for_people(ask: Run) -> None:
    answer = ask("query", "SELECT policy, count(*) AS n FROM v_trial GROUP BY 1 ORDER BY 1")
    lines = [line.split() for line in answer.out.splitlines()]
    assert lines == [["policy", "n"], ["d_optimal", "3"], ["random", "6"]]
    assert answer.err == ""


def test_csv_and_json_hold_every_digit(ask: Run) -> None:
    head, *rows = csv.reader(io.StringIO(ask("query", STEPS, "--csv").out))
    document, expected = ask("query", STEPS, "--json").document, result(DONE[0].seed).loss.tolist()
    assert head == document["columns"] == ["t", "loss"]
    assert [float(loss) for _, loss in rows] == expected
    assert [loss for _, loss in document["rows"]] == expected
    assert document["cut"] is False


@on_both
def test_what_is_missing_or_not_finite_is_null(ask: Run) -> None:
    sql = "SELECT loss, 1e308 * 10 FROM v_curve WHERE seed = 5 AND t = 4"
    if "postgresql" in ask("status", "--json").document["database"]:
        sql = "SELECT loss, 'NaN'::float8 FROM v_curve WHERE seed = 5 AND t = 4"
    assert ask("query", sql, "--json").document["rows"] == [[None, None]]
    assert ask("query", sql, "--csv").out.splitlines()[1] == ","


@on_both
def test_bytes_and_sums_are_json_too(ask: Run) -> None:
    sql = "SELECT sum(seed), avg(seed), max(states_shape), count(states) FROM trial JOIN trajectory"
    (row,) = ask("query", f"{sql} USING (trial_id)", "--json").document["rows"]
    assert row == [8, 2.0, f"[{HORIZON + 1}, 4]", 4]
    blob = "SELECT states FROM trajectory LIMIT 1"
    assert "(256 bytes)" in ask("query", blob).out
    (row,) = ask("query", blob, "--json").document["rows"]
    assert len(row[0]) == 344  # base64


def test_it_says_when_rows_are_cut(ask: Run) -> None:
    answer = ask("query", STEPS, "--limit", "2")
    assert len(answer.out.splitlines()) == 3
    expected = "note: only the first 2 rows are shown, --limit N gives more, --csv gives all.\n"
    assert answer.err == expected
    assert ask("query", STEPS, "--limit", "2", "--json").document["cut"] is True


@on_both
def test_what_is_refused_is_one_sentence(ask: Run) -> None:
    for sql in ("DELETE FROM step", "SELECT * FROM nowhere", "SELECT 1; SELECT 2", ""):
        answer = ask("query", sql)
        assert (answer.code, answer.out, answer.err.count("\n")) == (2, "", 1), answer.err
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT max(i) FROM n"
    answer = ask("query", endless, "--timeout", "0.2")
    assert answer.code == 2
    assert "longer than 0.2 s" in answer.err


def test_a_done_trial(ask: Run) -> None:
    spec = DONE[1]
    out = ask("show", spec.trial_key[:8]).out
    loss = result(spec.seed).loss
    assert out.startswith(f"{spec.trial_key[:12]} (pendulum, random, seed 1)\n")
    assert f"done · final loss {loss[-1]:.6g} · best loss {loss.min():.6g}" in out
    assert "horizon=7" in out
    assert "commit   0000000000000000000000000000000000000000, with changes (diff 1111" in out
    assert "launch.py -m" in out
    assert "8,192.00" in out  # MiB
    assert "Traceback" not in out


@on_both
def test_the_json_has_everything(ask: Run, grid: int) -> None:
    document = ask("show", DONE[1].trial_key, "--json").document
    assert document["trial"]["trial_key"] == DONE[1].trial_key
    assert document["config"] == DONE[1].columns()
    assert document["loss"] == result(1).loss.tolist()
    (launch,) = document["launches"]
    assert (launch["launch_id"], launch["git_dirty"], launch["alive"]) == (grid, True, True)
    (attempt,) = document["attempts"]
    assert (attempt["outcome"], attempt["node"], attempt["wall_seconds"]) == ("done", "here", 0.5)


@on_both
def test_a_failed_trial_shows_every_attempt(store: Store, ask: Run, grid: int) -> None:
    spec = BROKEN[0]
    store.retry("failed", [spec.trial_key])
    (claim,) = store.claim(grid, [spec.trial_key])
    store.fail(claim, failure(77, "timeout"), run_now())
    answer = ask("show", spec.trial_key[:8])
    assert "failed · ZeroDivisionError: seed 77 is broken" in answer.out
    assert "Traceback of attempt 2\nTraceback (most recent call last):" in answer.out
    attempts = ask("show", spec.trial_key[:8], "--json").document["attempts"]
    assert [attempt["cause"] for attempt in attempts] == ["exception", "timeout"]
    assert [attempt["message"] for attempt in attempts] == ["seed 3 is broken", "seed 77 is broken"]


def test_a_diverged_trial_has_null_where_it_is_not_finite(ask: Run) -> None:
    assert "diverged · at step 3" in ask("show", BAD.trial_key[:8]).out
    loss = ask("show", BAD.trial_key[:8], "--json").document["loss"]
    assert loss[:3] == result(BAD.seed).loss[:3].tolist()
    assert loss[3:] == [None] * (HORIZON - 3)


def test_a_trial_that_has_not_begun(ask: Run) -> None:
    waiting = Spec(0, env="cartpole", width=None)
    document = ask("show", waiting.trial_key, "--json").document
    assert (document["attempts"], document["launches"], document["loss"]) == ([], [], [])
    assert "pending" in ask("show", waiting.trial_key).out
    assert "running" in ask("show", RUNNING.trial_key).out


def test_a_trial_with_limits_shows_what_was_beyond_them(store: Store, ask: Run, grid: int) -> None:
    spec = Spec(9, policy="uniform")
    store.register(grid, [spec])
    (claim,) = store.claim(grid, [spec.trial_key])
    beyond = Assessment(HORIZON, "violations", 3.0), Assessment(HORIZON, "worst", 0.1234567)
    assert store.commit(claim, replace(result(9), assessments=beyond), run_now())
    assert "· violations 3 · worst 0.123457\n" in ask("show", spec.trial_key).out
    document = ask("show", spec.trial_key, "--json").document
    assert document["beyond_limits"] == {"violations": 3.0, "worst": 0.1234567}
    assert ask("show", DONE[1].trial_key, "--json").document["beyond_limits"] == {}


def test_names_instead_of_a_key(ask: Run) -> None:
    answer = ask("show", "--env", "cartpole", "--seed", "0", "--width", "8")
    assert answer.out.startswith(RUNNING.trial_key[:12])
    answer = ask("show", "--policy", "d_optimal", "--seed", "5")
    assert answer.out.startswith(BAD.trial_key[:12])


def test_what_is_ambiguous_is_refused_with_choices_told_apart(ask: Run, store: Store) -> None:
    answer = ask("show", "--env", "cartpole", "--seed", "0")
    assert answer.code == 2
    assert "2 trials have these names, one is expected: give the key of one of" in answer.err
    assert RUNNING.trial_key[:12] in answer.err
    assert "(cartpole, random, width=8, seed 0)" in answer.err
    number = store.begin_launch(LAUNCH)
    others = [Spec(9, gamma=0.5), Spec(9, gamma=3.0, task="control")]
    store.register(number, others)
    error = ask("show", "--seed", "9").err
    assert "(pendulum, random, gamma=0.5, seed 9)" in error
    assert "(pendulum, random, gamma=3.0, task=control, seed 9)" in error


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["ffffffffffffffff"], "There is no trial with a key that starts with ffff"),
        (["xyzt"], "first 4 hexadecimal digits"),
        (["--seed", "99"], "There is no trial with these names"),
        (["--seed", "9" * 20], "a whole number from 0 to 2^63 - 1 is expected"),
        (["--width", "-1"], "a whole number from 0 to 2^63 - 1 is expected"),
        (["--policy", "randon"], "did you mean 'random'?"),
    ],
)
def test_what_is_not_there_is_refused(ask: Run, words: list[str], hint: str) -> None:
    answer = ask("show", *words)
    assert (answer.code, answer.out) == (2, "")
    assert hint in answer.err
