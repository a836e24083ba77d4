"""``python -m analysis serve`` refuses what it cannot do in one sentence."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from analysis.cli import main
from analysis.serve.web import Cache, loss_text, plain


@pytest.fixture
def taken() -> Iterator[int]:
    """Return a port that somebody listens at until the test ends."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening.getsockname()[1]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--port", "99999"], "expected is a number of 0 to 65535"),
        (["--port", "many"], "invalid int value: 'many'"),
        (["--host", "203.0.113.7"], "cannot listen at 203.0.113.7"),
        (["--host", "no.such.host.invalid"], "cannot listen at no.such.host.invalid"),
        (["--db", "nothing"], "The database URL cannot be read"),
        (["--where", "model.width=3"], "--where"),
        (["--db", "sqlite:///a.db", "sqlite:///b.db"], "orchestrate merge"),
        (["--figures", "figures"], "open README.md"),
    ],
)
def test_a_wrong_request_is_one_sentence(
    capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert main(["serve", *arguments]) == 2
    captured = capsys.readouterr()
    assert sentence in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_a_port_that_is_taken_is_one_sentence(
    capsys: pytest.CaptureFixture[str], taken: int
) -> None:
    assert main(["serve", "--port", str(taken)]) == 2
    assert "--port 0 takes any free port" in capsys.readouterr().err


def test_without_its_libraries_it_says_which_to_install(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "analysis.serve.server", raising=False)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert main(["serve"]) == 2
    assert "pip install 'dopt-exploration[serve]'" in capsys.readouterr().err


def test_a_kept_value_is_not_computed_again_until_it_is_forgotten() -> None:
    memory, seen = Cache(size=2), []

    def value(key: str) -> str:
        return memory.get_or_compute(key, lambda: seen.append(key) or key.upper())

    assert [value(key) for key in ("a", "a", "b", "a", "c", "a", "b")] == list("AABACAB")
    assert seen == ["a", "b", "c", "b"]


def test_numbers_that_are_not_finite_are_null() -> None:
    found = plain({"a": [float("nan"), float("inf"), 1.5], "b": (True, None, Path("x"))})
    assert found == {"a": [None, None, 1.5], "b": [True, None, "x"]}


def test_small_losses_are_written_with_a_power_of_ten() -> None:
    assert loss_text(0.804, 0.112) == "0.80 ± 0.11"
    assert loss_text(3.449e-4, 3.86e-5) == "(3.45 ± 0.39) · 10⁻⁴"
    assert loss_text(float("nan"), None) == "–"
    assert loss_text(1.5, float("nan")) == "1.50"
