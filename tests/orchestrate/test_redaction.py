"""A password shows nowhere, wherever it was given."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.errors import without_password, without_password_in_word
from orchestrate.runner.saving import launch_record
from tests.orchestrate.conftest import Launches


@pytest.mark.parametrize(
    ("word", "safe"),
    [
        ("store.url=postgresql://me:pa:ss@host:5432/db", "store.url=postgresql://me:***@host:5432/db"),
        ("postgresql+psycopg://:pw@host/db", "postgresql+psycopg://:***@host/db"),
        ("--db=postgresql://h/db?user=me&password=pw&x=1", "--db=postgresql://h/db?user=me&password=***&x=1"),
        ("postgresql://me:p@ss@host/db?sslpassword=a@b", "postgresql://me:***@host/db?sslpassword=***"),
        ("sqlite:///results/results.db", "sqlite:///results/results.db"),
        ("ray://host:10001", "ray://host:10001"),
        ("postgresql://host:5432/db", "postgresql://host:5432/db"),
        ("policy=glob(*)", "policy=glob(*)"),
    ],
)  # fmt: skip
def test_the_rest_of_a_word_stays(word: str, safe: str) -> None:
    assert without_password_in_word(word) == safe
    assert without_password(word) == safe


def test_a_sentence_keeps_its_other_words() -> None:
    sentence = "cannot reach postgresql://me:secret@host:1/db, nor ray://host:2: ask me@example.org"
    assert without_password(sentence) == sentence.replace("secret", "***")


PLACES: dict[str, Callable[[str], str]] = {
    "a URL": lambda password: f"store.url=postgresql://me:{quote(password, safe='')}@host:5432/db",
    "a URL, as it is": lambda password: f"store.url=postgresql://me:{password}@host:5432/db",
    "a quoted URL": lambda password: f"store.url='postgresql://me:{quote(password)}@host/db'",
    "a section": lambda password: f"store={{url:'postgresql://:{quote(password)}@host/db'}}",
    "the query": lambda password: f"store.url=postgresql://host/db?password={quote(password)}",
    "a key's": lambda password: f"--db=postgresql://host/db?x=1&sslpassword={quote(password)}&y=2",
    "a cluster": lambda password: f"launch.ray.address=ray://me:{quote(password, safe='')}@host",
}
PASSWORDS = st.text(
    st.characters(codec="ascii", exclude_categories=["Cc", "Cs"]), min_size=8, max_size=20
).filter(lambda text: text.strip() == text and not set(text) & set("@&'"))


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(password=PASSWORDS, place=st.sampled_from(sorted(PLACES)))
def test_no_password_of_a_command_line_is_written_down_or_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, password: str, place: str
) -> None:
    word = PLACES[place](password)
    monkeypatch.setattr(sys, "argv", ["launch.py", word])
    record = launch_record(sys.argv, [word], tmp_path)
    trouble = f"Traceback: connecting with {password!s} failed\nValueError: {word}"
    shown = "\n".join([*record.argv, *record.overrides, without_password(trouble)])
    assert password not in shown
    assert quote(password, safe="") not in shown
    assert quote(password) not in shown


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(password=PASSWORDS, name=st.sampled_from(["PGPASSWORD", "MY_DB_PASSWORD", "A_TOKEN"]))
def test_no_password_of_the_environment_is_said(
    monkeypatch: pytest.MonkeyPatch, password: str, name: str
) -> None:
    monkeypatch.setattr(sys, "argv", ["launch.py"])
    with monkeypatch.context() as variables:
        variables.setenv(name, password)
        assert password not in without_password(f"'{password}' was refused; {password}")
    with monkeypatch.context() as variables:
        variables.setenv("DOPT_DB", f"postgresql://me:{quote(password, safe='')}@host/db")
        assert password not in without_password(f"'{password}' was refused; {password}")


PASSWORD = "never to be seen"


def leaking(_: TrialSpec) -> TrialResult:
    """Say the password as a library does that prints its environment."""
    raise ConnectionError(f"cannot connect with {os.environ['PGPASSWORD']} to {os.environ['MINE']}")


def test_no_row_of_the_database_holds_a_password_that_a_trial_said(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PGPASSWORD", PASSWORD)
    monkeypatch.setenv("MINE", "postgresql://me:another%20secret@host/db")
    launches(leaking, seeds=2)
    rows = str(launches.query("SELECT type, message, traceback FROM error"))
    assert "ConnectionError" in rows
    assert "cannot connect with *** to postgresql://me:***@host/db" in rows
    assert PASSWORD not in rows
    assert "another" not in rows


@settings(
    max_examples=6,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    phases=[Phase.generate],  # a launch is too slow to look for a shorter password
)
@given(password=PASSWORDS.map(lambda text: f"{text}~{text}"))  # a plain word may be there anyway
def test_neither_a_row_nor_a_word_of_a_launch_holds_a_password(
    command_line: Callable[..., tuple[int, str, str]], tmp_path: Path, password: str
) -> None:
    quoted = quote(password, safe="")
    server = f"postgresql://me:{quoted}@127.0.0.1:1/db?application_name=dopt"
    short = ("env.horizon=5", "executor=inprocess", "launch.patience=0.3")
    code, output, errors = command_line("-m", "seed=1,2", f"store.url='{server}'", *short)
    assert code == 75, errors
    address = f"launch.ray.address='ray://me:{quoted}@host:1'"
    code, more, _ = command_line("-m", "seed=1,2", address, *short)
    assert code == 0
    files = [path for path in (tmp_path / "results").rglob("*") if path.is_file()]
    stored = b"".join(path.read_bytes() for path in files)
    for shown in (output.encode(), errors.encode(), more.encode(), stored):
        assert password.encode() not in shown
        assert quoted.encode() not in shown
    assert b"ray://me:***@host:1" in stored
