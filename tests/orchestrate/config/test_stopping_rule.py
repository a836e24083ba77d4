"""``launch.until`` on the command line."""

from __future__ import annotations

from collections.abc import Callable

import pytest

CommandLine = Callable[..., tuple[int, str, str]]
GRID = ("-m", "policy=d_optimal,random", "env.horizon=5", "seed=range(20)", "executor=inprocess")


@pytest.mark.parametrize("until", ["ci<5%", "ci < 12.5 %", "'ci<5%'"])
def test_a_command_line_takes_a_rule(command_line: CommandLine, until: str) -> None:
    code, output, errors = command_line(*GRID, f"launch.until={until}")
    assert (code, "error:" in errors) == (0, False), errors
    assert "40 of 40 trials (100 %), 0 of 2 means known" in output


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["launch.until=soon"], "launch.until is 'soon', but null or ci<P%"),
        (["launch.until=ci<0%"], "launch.until is 'ci<0%', but null or ci<P%"),
        (["launch.until=ci<100%"], "launch.until is 'ci<100%', but null or ci<P%"),
        (["launch.until=ci<5"], "P percent), such as 'ci<5%', is expected: change launch.until."),
        (["launch.until=5"], "launch.until is 5, but null or ci<P%"),
    ],
)
def test_what_is_no_rule_is_refused(
    command_line: CommandLine, words: list[str], sentence: str
) -> None:
    code, output, errors = command_line(*GRID, *words)
    assert (code, output, errors.count("\n")) == (2, "", 1)
    assert sentence in errors


def test_a_single_trial_has_no_seeds_to_choose_from(command_line: CommandLine) -> None:
    code, _, errors = command_line("env.horizon=5", "launch.until=ci<5%")
    assert code == 2
    assert "a single trial is asked for: add -m" in errors


def test_a_dry_run_says_that_these_are_the_most(command_line: CommandLine) -> None:
    output = command_line(*GRID, "launch.until=ci<5%", "launch.dry_run=true")[1]
    assert output.endswith("launch.until may need fewer of these seeds: they are run in batches\n")
