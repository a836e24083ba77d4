"""The one line, as it is seen by a terminal and by a file."""

from __future__ import annotations

import io
from collections.abc import Callable

import pytest

from orchestrate.runner.progress import Progress, Tally, duration


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Return a function that lets time pass."""
    now = [0.0]
    monkeypatch.setattr("orchestrate.runner.progress.time.monotonic", lambda: now[0])

    def passes(seconds: float) -> None:
        now[0] += seconds

    return passes


def test_the_line_has_the_outcomes_the_rate_and_the_time_left(
    clock: Callable[[float], None],
) -> None:
    tally = Tally(total=2000, before=500, failed_before=3)
    shown = Progress(tally, io.StringIO())
    tally.done, tally.diverged, tally.failed = 145, 4, 1
    clock(10.0)
    shown.update()
    assert shown.line() == (
        "650 of 2,000 · 145 done now · 4 failed · 4 diverged · 15.0/s · 1 min 30 s left"
    )


def test_the_time_left_is_not_estimated_before_a_tenth_of_the_trials(
    clock: Callable[[float], None],
) -> None:
    """A grid of 100 s said "1 h 46 min left": its first trials waited for the workers to start."""
    tally = Tally(total=600, before=100)
    shown = Progress(tally, None)
    tally.done = 49
    clock(30.0)
    shown.update()
    assert "left" not in shown.line()
    tally.done = 50
    assert shown.line().endswith("4 min 36 s left")


def test_the_rate_is_that_of_the_last_half_minute(clock: Callable[[float], None]) -> None:
    tally = Tally(total=1000)
    shown = Progress(tally, None)
    for _ in range(60):
        clock(1.0)
        shown.update()
    for _ in range(60):
        tally.done += 2
        clock(1.0)
        shown.update()
    assert "2.0/s" in shown.line()


def test_a_file_gets_a_line_now_and_then_and_one_at_the_end(
    clock: Callable[[float], None],
) -> None:
    stream = io.StringIO()
    tally = Tally(total=100)
    with Progress(tally, stream) as shown:
        for _ in range(45):
            tally.done += 1
            clock(0.5)
            shown.update()
    lines = stream.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[-1].startswith("45 of 100")
    assert "\x1b" not in stream.getvalue()


def test_a_terminal_gets_one_line_in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: True)
    tally = Tally(total=10)
    with Progress(tally, stream) as shown:
        tally.done = 10
        shown.update()
    assert "10 of 10" in stream.getvalue()
    assert "\x1b[" in stream.getvalue()


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.2, "0 s"), (59, "59 s"), (125, "2 min 05 s"), (7260, "2 h 01 min")]
)
def test_durations_are_for_people(seconds: float, words: str) -> None:
    assert duration(seconds) == words
