"""The exact comparison of two results databases."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from benchmarks.bit_equality import main

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


def test_equal_numbers_are_equal_whatever_the_times(tmp_path: Path) -> None:
    assert main([database(tmp_path / "old.db"), database(tmp_path / "new.db")]) == 0


@pytest.mark.parametrize(
    ("changed", "line"),
    [
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
    assert main([old, new]) == 1
    assert line in capsys.readouterr().out


def test_two_databases_are_expected(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["nowhere.db"]) == 2
    assert "two SQLite databases are expected" in capsys.readouterr().out
