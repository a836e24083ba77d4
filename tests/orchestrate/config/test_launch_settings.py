"""Limits and patience of a launch: what is refused, and what is taken."""

from __future__ import annotations

from collections.abc import Callable

import pytest

CommandLine = Callable[..., tuple[int, str, str]]

TRIAL = ("env.horizon=5", "executor=inprocess")


@pytest.mark.parametrize(
    "words",
    [
        ["launch.timeout=null"],
        ["launch.timeout=0.5"],
        ["launch.timeout=7"],
        ["launch.memory_gib=1.5"],
        ["launch.memory_gib=2", "launch.retry_memory=1.5"],
        ["launch.lease=20", "launch.patience=10.5"],
    ],
    ids=" ".join,
)
def test_what_is_taken(command_line: CommandLine, words: list[str]) -> None:
    code, output, errors = command_line(*TRIAL, *words)
    assert (code, errors) == (0, "")
    assert "final loss" in output


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("launch.timeout=0", "launch.timeout is 0, but null or a number of seconds above 0"),
        ("launch.timeout=-1", "launch.timeout is -1, but null or a number of seconds above 0"),
        ("launch.timeout=inf", "launch.timeout is inf, but null or a number of seconds"),
        ("launch.timeout=soon", "launch.timeout"),
        ("launch.timeout=true", "launch.timeout"),
        ("launch.memory_gib=0", "launch.memory_gib is 0, but null or a number of GiB above 0"),
        ("launch.retry_memory=2", "launch.retry_memory is 2, but there is no limit that it could"),
        ("launch.lease=null", "launch.lease"),
        ("launch.lease=10", "launch.patience is 30, but less than launch.lease=10 is expected"),
        ("launch.patience=60", "launch.patience is 60, but less than launch.lease=60 is expected"),
    ],
)
def test_what_is_refused(command_line: CommandLine, word: str, sentence: str) -> None:
    code, output, errors = command_line(*TRIAL, word)
    assert (code, output, errors.count("\n")) == (2, "", 1)
    assert sentence in errors


def test_a_factor_of_memory_is_above_one(command_line: CommandLine) -> None:
    code, _, errors = command_line(*TRIAL, "launch.memory_gib=1", "launch.retry_memory=1")
    assert code == 2
    assert (
        "launch.retry_memory is 1, but null or a factor above 1, at most 100, is expected" in errors
    )
