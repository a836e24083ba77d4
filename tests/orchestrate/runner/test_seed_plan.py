"""A launch with ``launch.until`` runs seeds in batches, and ends the same however it was run."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid, LaunchSettings
from orchestrate.errors import ExitCode
from orchestrate.executors.base import Run
from orchestrate.runner.seed_plan import (
    FEWEST_SEEDS,
    FEWEST_VALUES,
    MOST_LOOKS,
    half_width,
    is_narrow,
    looks,
)
from orchestrate.runner.start import Output, Work, launch_grid
from tests.orchestrate.conftest import RECORD, Launches
from tests.orchestrate.standins import diverged, grid_of, quick

SEEDS = 40
SPREADS = {"d_optimal": 0.02, "uniform": 0.1, "periodic": 0.13, "random": 0.5}
"""Spread of the logarithm of the final loss with each policy; its mean is 0."""


def grid(policies: Sequence[str] = tuple(SPREADS), seeds: int = SEEDS) -> Grid:
    return grid_of(policies, seeds)


def lossy(spec: TrialSpec) -> TrialResult:
    """Return a loss of its policy, drawn by the policy and the seed of the trial."""
    result = quick(spec)
    noise = np.random.default_rng([*spec.policy.name.encode(), spec.seed]).standard_normal()
    loss = np.exp(SPREADS[spec.policy.name] * noise)
    return dataclasses.replace(result, loss=np.full_like(result.loss, loss))


def stopped_after(trials: int) -> Run:
    """Return a function that is interrupted, as by two Ctrl-C, after a number of trials."""
    count = 0

    def run(spec: TrialSpec) -> TrialResult:
        nonlocal count
        count += 1
        if count > trials:
            raise KeyboardInterrupt
        return lossy(spec)

    return run


def unlucky(spec: TrialSpec, *, fail: bool) -> TrialResult:
    """Lose every fifth seed of the uniform policy."""
    if spec.policy.name != "uniform" or spec.seed % 5:
        return lossy(spec)
    if fail:
        raise ZeroDivisionError("an unlucky seed")
    return diverged(spec, at=3)


class Adaptive(Launches):
    """Launches of a grid with a rule into one database; ``said`` is of the last one."""

    def __call__(  # type: ignore[override]
        self,
        run: Run = lossy,
        until: float | None = 0.05,
        of: Grid | None = None,
        **settings: object,
    ) -> ExitCode:
        self.said = []
        chosen = {"executor": "inprocess", "workers": 2, **settings}
        made = LaunchSettings(store_url=self.url, until=until, **chosen)  # type: ignore[arg-type]
        work = Work(run)
        return launch_grid(of or grid(), made, RECORD, work, Output(*2 * [self.said.append]))

    @property
    def report(self) -> str:
        return self.said[-1]

    def result(self, policy: str) -> tuple[int, str]:
        """Return the seeds of a policy in the report, and its result."""
        label = {"d_optimal": "D-optimal"}.get(policy, policy)
        line = rf"^pendulum +{label}, .*?  (\d+) +(.*)$"
        match = re.search(line, self.report, flags=re.MULTILINE)
        assert match, self.report
        return int(match[1]), match[2]

    def outcomes(self) -> list[tuple[Any, ...]]:
        """Return what the database holds, pending trials included."""
        return self.query("SELECT policy, seed, status FROM v_trial ORDER BY policy, seed")


@pytest.fixture
def adaptive(tmp_path: Path) -> Adaptive:
    return Adaptive(tmp_path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Adaptive:
    """Return a launch that was not interrupted."""
    found = Adaptive(tmp_path_factory.mktemp("whole"))
    assert found() == ExitCode.DONE
    return found


def test_a_small_spread_needs_few_seeds_and_a_large_one_all(whole: Adaptive) -> None:
    seeds = {policy: whole.result(policy)[0] for policy in SPREADS}
    assert seeds["d_optimal"] == 20
    assert 20 < seeds["uniform"] < SEEDS
    assert seeds["random"] == SEEDS
    match = re.fullmatch(r"mean (\S+) ± (\S+) %, known", whole.result("d_optimal")[1])
    assert match
    assert float(match[1]) == pytest.approx(1.0, abs=0.03)
    assert float(match[2]) < 5
    assert whole.result("random")[1].endswith("%")
    assert re.search(
        rf"{sum(seeds.values())} of 160 trials .*, [23] of 4 means known$", whole.report
    )


def test_the_database_holds_the_seeds_of_the_report_and_nothing_is_left_pending(
    whole: Adaptive,
) -> None:
    for policy in SPREADS:
        seeds = [seed for name, seed, _ in whole.outcomes() if name == policy]
        assert seeds == list(range(whole.result(policy)[0]))
    assert {status for _, _, status in whole.outcomes()} == {"done"}


@pytest.mark.parametrize("trials", [0, 40, 41, 100])
def test_an_interrupted_launch_ends_as_one_that_was_not(
    adaptive: Adaptive, whole: Adaptive, trials: int
) -> None:
    assert adaptive(stopped_after(trials)) == ExitCode.INTERRUPTED
    assert sum(status == "done" for _, _, status in adaptive.outcomes()) <= trials
    assert adaptive() == ExitCode.DONE
    assert adaptive.report == whole.report
    assert adaptive.outcomes() == whole.outcomes()


def test_the_same_command_again_runs_nothing_and_reports_the_same(whole: Adaptive) -> None:
    before, report = whole.outcomes(), whole.report

    def refuse(spec: TrialSpec) -> TrialResult:
        raise AssertionError(f"{spec} runs again")

    assert whole(refuse) == ExitCode.DONE
    assert whole.report == report
    assert all("nothing to run" in line for line in whole.said[:-1])
    assert whole.outcomes() == before


def test_trials_that_are_there_already_change_no_mean(adaptive: Adaptive, whole: Adaptive) -> None:
    """All seeds of all policies were run, in another order."""
    backwards = grid()
    backwards.trials.reverse()
    assert adaptive(of=backwards, until=None) == ExitCode.DONE
    assert adaptive() == ExitCode.DONE
    assert adaptive.report == whole.report


def test_worker_processes_end_at_the_same_report(adaptive: Adaptive, whole: Adaptive) -> None:
    assert adaptive(executor="local") == ExitCode.DONE
    assert adaptive.report == whole.report
    assert adaptive.outcomes() == whole.outcomes()


@pytest.mark.parametrize("fail", [True, False])
def test_failed_and_diverged_trials_are_no_values_and_block_nothing(
    adaptive: Adaptive, fail: bool
) -> None:
    code = adaptive(partial(unlucky, fail=fail))
    assert code == (ExitCode.SOME_FAILED if fail else ExitCode.DONE)
    seeds, _ = adaptive.result("uniform")
    statuses = [status for name, _, status in adaptive.outcomes() if name == "uniform"]
    assert statuses.count("failed" if fail else "diverged") == seeds // 5
    assert adaptive.result("random")[0] == SEEDS


def test_a_policy_of_which_all_trials_fail_ends_with_all_seeds(adaptive: Adaptive) -> None:
    def broken(spec: TrialSpec) -> TrialResult:
        if spec.policy.name == "uniform":
            raise ZeroDivisionError("no trial of it works")
        return lossy(spec)

    assert adaptive(broken, of=grid(["d_optimal", "uniform"], 25)) == ExitCode.SOME_FAILED
    assert adaptive.result("uniform") == (25, "mean unknown")


def test_fail_fast_starts_no_further_batch(adaptive: Adaptive) -> None:
    code = adaptive(partial(unlucky, fail=True), fail_fast=True)
    assert code == ExitCode.SOME_FAILED
    assert "stopped at the first failure" in adaptive.report
    assert max(seed for _, seed, _ in adaptive.outcomes()) < 10


def test_failed_trials_that_run_again_count(adaptive: Adaptive, whole: Adaptive) -> None:
    adaptive(partial(unlucky, fail=True))
    assert adaptive(retry="failed") == ExitCode.DONE
    assert adaptive.report == whole.report


@pytest.mark.parametrize("maximum", [1, 9, 10, 11, 25, 100, 199, 200, 201, 1000, 12_345])
def test_looks_are_spaced_evenly_up_to_the_maximum(maximum: int) -> None:
    found = looks(maximum)
    assert found[-1] == maximum
    assert len(found) <= MOST_LOOKS
    steps = np.diff([0, *found])
    assert np.all(steps > 0)
    assert len(set(steps[:-1])) <= 1, "only the last one may be shorter"
    assert steps[-1] <= steps[0]
    assert all(step % FEWEST_SEEDS == 0 for step in steps[:-1])


def test_the_half_width_is_students() -> None:
    from scipy import stats  # a worker, which imports this module, needs none of it

    losses = np.exp(np.random.default_rng(0).standard_normal(30))
    logs = np.log(losses)
    low, high = stats.t.interval(0.98, 29, np.mean(logs), stats.sem(logs))
    assert half_width(losses) == pytest.approx((high - low) / 2)


def test_a_narrow_interval_needs_values_that_have_a_logarithm() -> None:
    same = np.full(FEWEST_VALUES, 2.0)
    assert is_narrow(same, 0.01)
    for losses in (same[1:], np.append(same, np.inf), np.append(same, 0.0), np.array([])):
        assert not is_narrow(losses, 0.01)
