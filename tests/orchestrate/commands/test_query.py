"""``query``: tables, CSV and JSON of one SELECT."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable

import pytest

from tests.orchestrate.commands.conftest import DONE, Answer
from tests.orchestrate.store.fakes import HORIZON, result

Run = Callable[..., Answer]
pytestmark = pytest.mark.usefixtures("grid")

STEPS = (
    "SELECT t, loss FROM v_curve WHERE env = 'pendulum' AND policy = 'random' AND seed = 0"
    " ORDER BY t"
)


def test_a_table_for_people(command: Run) -> None:
    answer = command("query", "SELECT policy, count(*) AS n FROM v_trial GROUP BY 1 ORDER BY 1")
    lines = [line.split() for line in answer.out.splitlines()]
    assert lines == [["policy", "n"], ["d_optimal", "3"], ["random", "6"]]
    assert answer.err == ""


def test_csv_holds_every_digit(command: Run) -> None:
    answer = command("query", STEPS, "--csv")
    head, *rows = csv.reader(io.StringIO(answer.out))
    assert head == ["t", "loss"]
    assert [float(loss) for _, loss in rows] == result(DONE[0].seed).loss.tolist()


def test_json_has_columns_and_rows(command: Run) -> None:
    answer = command("query", STEPS, "--json")
    assert answer.document["columns"] == ["t", "loss"]
    losses = [loss for _, loss in answer.document["rows"]]
    assert losses == result(DONE[0].seed).loss.tolist()
    assert answer.document["cut"] is False


def test_what_is_missing_or_not_finite_is_null(command: Run) -> None:
    sql = "SELECT loss, 1e308 * 10 FROM v_curve WHERE seed = 5 AND t = 4"
    if "postgresql" in command("status", "--json").document["database"]:
        sql = "SELECT loss, 'NaN'::float8 FROM v_curve WHERE seed = 5 AND t = 4"
    assert command("query", sql, "--json").document["rows"] == [[None, None]]
    assert command("query", sql, "--csv").out.splitlines()[1] == ","


def test_bytes_and_sums_are_json_too(command: Run) -> None:
    sql = "SELECT sum(seed), avg(seed), max(states_shape), count(states) FROM trial JOIN trajectory"
    (row,) = command("query", f"{sql} USING (trial_id)", "--json").document["rows"]
    assert row == [8, 2.0, f"[{HORIZON + 1}, 4]", 4]
    blob = "SELECT states FROM trajectory LIMIT 1"
    assert "(256 bytes)" in command("query", blob).out
    (row,) = command("query", blob, "--json").document["rows"]
    assert len(row[0]) == 344  # base64


def test_it_says_when_rows_are_cut(command: Run) -> None:
    answer = command("query", STEPS, "--limit", "2")
    assert len(answer.out.splitlines()) == 3
    assert (
        answer.err
        == "note: only the first 2 rows are shown, --limit N gives more, --csv gives all.\n"
    )
    assert command("query", STEPS, "--limit", "2", "--json").document["cut"] is True


def test_what_is_refused_is_one_sentence(command: Run) -> None:
    for sql in ("DELETE FROM step", "SELECT * FROM nowhere", "SELECT 1; SELECT 2", ""):
        answer = command("query", sql)
        assert (answer.code, answer.out, answer.err.count("\n")) == (2, "", 1), answer.err
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT max(i) FROM n"
    answer = command("query", endless, "--timeout", "0.2")
    assert answer.code == 2
    assert "longer than 0.2 s" in answer.err


def test_no_text_of_the_database_drives_the_terminal(command: Run) -> None:
    sql = "SELECT chr(27) || '[31m' AS x" if _is_postgresql(command) else "SELECT char(27, 91) AS x"
    assert "\x1b" not in command("query", sql).out


def _is_postgresql(command: Run) -> bool:
    return str(command("status", "--json").document["database"]).startswith("postgresql")
