"""``show``: one trial, however it is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dopt.result import Assessment
from orchestrate.commands.results import sparkline
from orchestrate.store import Store
from tests.orchestrate.commands.conftest import BAD, BROKEN, DONE, RUNNING, Answer, failure, run_now
from tests.orchestrate.store.fakes import HORIZON, LAUNCH, Spec, result

Run = Callable[..., Answer]
pytestmark = pytest.mark.usefixtures("grid")


def test_a_done_trial(command: Run) -> None:
    spec = DONE[1]
    out = command("show", spec.trial_key[:8]).out
    loss = result(spec.seed).loss
    assert out.startswith(
        f"{spec.trial_key[:12]} (env=pendulum policy=random model=mlp learner=adam_window "
        "width=16 depth=2 horizon=7 dt=0.01 gamma=1.5 seed=1)\n"
    )
    assert f"done · final loss {loss[-1]:.6g} · best loss {loss.min():.6g}" in out
    assert "horizon=7" in out
    assert "commit   0000000000000000000000000000000000000000, with changes (diff 1111" in out
    assert "launch.py -m" in out
    assert "8,192.00" in out  # MiB
    assert "Traceback" not in out


def test_the_json_has_everything(command: Run, grid: int) -> None:
    document = command("show", DONE[1].trial_key, "--json").document
    assert document["trial"]["trial_key"] == DONE[1].trial_key
    assert document["config"] == DONE[1].columns()
    assert document["loss"] == result(1).loss.tolist()
    (launch,) = document["launches"]
    assert (launch["launch_id"], launch["git_dirty"], launch["alive"]) == (grid, True, True)
    (attempt,) = document["attempts"]
    assert (attempt["outcome"], attempt["node"], attempt["wall_seconds"]) == ("done", "here", 0.5)


def test_a_failed_trial_shows_every_attempt(store: Store, command: Run, grid: int) -> None:
    spec = BROKEN[0]
    store.retry("failed", [spec.trial_key])
    (claim,) = store.claim(grid, [spec.trial_key])
    store.fail(claim, failure(77, "timeout"), run_now())
    answer = command("show", spec.trial_key[:8])
    assert "failed · ZeroDivisionError: seed 77 is broken" in answer.out
    assert "Traceback of attempt 2\nTraceback (most recent call last):" in answer.out
    attempts = command("show", spec.trial_key[:8], "--json").document["attempts"]
    assert [attempt["cause"] for attempt in attempts] == ["exception", "timeout"]
    assert [attempt["message"] for attempt in attempts] == [
        "seed 3 is broken",
        "seed 77 is broken",
    ]


def test_a_diverged_trial_has_null_where_it_is_not_finite(command: Run) -> None:
    assert "diverged · at step 3" in command("show", BAD.trial_key[:8]).out
    loss = command("show", BAD.trial_key[:8], "--json").document["loss"]
    assert loss[:3] == result(BAD.seed).loss[:3].tolist()
    assert loss[3:] == [None] * (HORIZON - 3)


def test_a_trial_that_has_not_begun(command: Run) -> None:
    waiting = Spec(0, env="cartpole", width=None)
    document = command("show", waiting.trial_key, "--json").document
    assert (document["attempts"], document["launches"], document["loss"]) == ([], [], [])
    assert "pending" in command("show", waiting.trial_key).out
    assert "running" in command("show", RUNNING.trial_key).out


def test_a_trial_with_limits_shows_what_was_beyond_them(
    store: Store, command: Run, grid: int
) -> None:
    spec = Spec(9, policy="uniform")
    store.register(grid, [spec])
    (claim,) = store.claim(grid, [spec.trial_key])
    beyond = Assessment(HORIZON, "violations", 3.0), Assessment(HORIZON, "worst", 0.1234567)
    assert store.commit(claim, replace(result(9), assessments=beyond), run_now())
    assert "· violations 3 · worst 0.123457\n" in command("show", spec.trial_key).out
    document = command("show", spec.trial_key, "--json").document
    assert document["beyond_limits"] == {"violations": 3.0, "worst": 0.1234567}
    assert command("show", DONE[1].trial_key, "--json").document["beyond_limits"] == {}


def test_names_instead_of_a_key(command: Run) -> None:
    answer = command("show", "--env", "cartpole", "--seed", "0", "--width", "8")
    assert answer.out.startswith(RUNNING.trial_key[:12])
    answer = command("show", "--policy", "d_optimal", "--seed", "5")
    assert answer.out.startswith(BAD.trial_key[:12])


def test_what_is_ambiguous_is_refused_with_the_choices(command: Run) -> None:
    answer = command("show", "--env", "cartpole", "--seed", "0")
    assert answer.code == 2
    assert "2 trials have these names, one is expected: give the key of one of" in answer.err
    assert RUNNING.trial_key[:12] in answer.err
    assert "env=cartpole policy=random width=8 seed=0" in answer.err


def test_choices_name_the_columns_in_which_they_differ(command: Run, store: Store) -> None:
    number = store.begin_launch(LAUNCH)
    others = [Spec(9, gamma=0.5), Spec(9, gamma=3.0, task="control")]
    store.register(number, others)
    error = command("show", "--seed", "9").err
    assert "(env=pendulum policy=random width=16 gamma=0.5 seed=9)" in error
    assert "(env=pendulum policy=random width=16 gamma=3.0 task=control seed=9)" in error


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
def test_what_is_not_there_is_refused(command: Run, words: list[str], hint: str) -> None:
    answer = command("show", *words)
    assert (answer.code, answer.out) == (2, "")
    assert hint in answer.err


class TestSparkline:
    def test_it_falls_on_a_logarithmic_scale(self) -> None:
        assert sparkline([10.0**-i for i in range(8)]) == "█▇▆▅▄▃▂▁"

    def test_it_has_at_most_so_many_columns(self) -> None:
        assert len(sparkline(list(np.geomspace(1, 2, 1000)), columns=60)) == 60

    def test_a_part_without_numbers_is_empty(self) -> None:
        assert sparkline([1.0, 0.1, None, None]) == "█▁  "

    @pytest.mark.parametrize("values", [[], [None, None]])
    def test_without_numbers_there_is_none(self, values: list[None]) -> None:
        assert sparkline(values) == ""

    def test_equal_and_zero_losses_are_drawn(self) -> None:
        assert sparkline([2.0, 2.0]) == "▁▁"
        assert sparkline([0.0, 0.0]) == "▁▁"
        assert sparkline([1.0, 0.0]) == "▁▁"
