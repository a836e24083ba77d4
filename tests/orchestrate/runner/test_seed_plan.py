"""A launch with ``launch.until`` runs seeds in batches, and decides the same however it was run."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.config.grid import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.config.stopping_rule import Until, UntilDecided, UntilPrecise
from orchestrate.errors import ExitCode
from orchestrate.executors.base import Run
from orchestrate.runner.run_grid import Work, launch_grid
from orchestrate.store import Reader
from tests.orchestrate.conftest import RECORD
from tests.orchestrate.standins import diverged, grid_of, quick, trial_of

SEEDS = 60
FACTORS = {"d_optimal": 1.0, "uniform": 3.0, "periodic": 0.4, "random": 1.0}
"""Geometric mean of the final loss with each policy; its logarithm has the spread below."""

SPREADS = {"d_optimal": 0.5, "uniform": 0.5, "periodic": 0.5, "random": 0.5, "random_held": 0.02}


def grid(policies: Sequence[str] = tuple(FACTORS), seeds: int = SEEDS) -> Grid:
    return grid_of(policies, seeds)


def lossy(spec: TrialSpec) -> TrialResult:
    """Return a loss of its policy, drawn by the key of the trial."""
    result = quick(spec)
    noise = np.random.default_rng(int(spec.trial_key[:12], 16)).standard_normal()
    policy = spec.policy.name
    loss = FACTORS.get(policy, 1.0) * np.exp(SPREADS[policy] * noise)
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


class Adaptive:
    """Launches of a grid with a rule into one database."""

    def __init__(self, folder: Path) -> None:
        self.url = f"sqlite:///{folder / 'results.db'}"
        self.said: list[str] = []

    def __call__(
        self,
        run: Run = lossy,
        until: Until | None = UntilDecided(),  # noqa: B008  # frozen
        of: Grid | None = None,
        **settings: object,
    ) -> ExitCode:
        self.said = []
        chosen = {"executor": "inprocess", "workers": 2, **settings}
        made = LaunchSettings(store_url=self.url, until=until, **chosen)  # type: ignore[arg-type]
        work = Work(run, prepare=lambda: None)
        return launch_grid(of or grid(), made, RECORD, work, self.said.append, stream=None)

    @property
    def report(self) -> str:
        return self.said[-1]

    def result(self, policy: str) -> tuple[int, str]:
        """Return the seeds of a policy in the report, and its result."""
        label = {"d_optimal": "D-optimal", "random_held": "held random"}.get(policy, policy)
        line = rf"^pendulum +{label}, .*?  (\d+) +(.*)$"
        match = re.search(line, self.report, flags=re.MULTILINE)
        assert match, self.report
        return int(match[1]), match[2]

    def outcomes(self) -> list[tuple[str, int, str]]:
        """Return what the database holds, pending trials included."""
        sql = "SELECT policy, seed, status FROM v_trial ORDER BY policy, seed"
        with Reader.open(self.url) as reader:
            return [(str(row[0]), int(row[1]), str(row[2])) for row in reader.query(sql)]


@pytest.fixture
def adaptive(tmp_path: Path) -> Adaptive:
    return Adaptive(tmp_path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Adaptive:
    """Return a launch that was not interrupted."""
    found = Adaptive(tmp_path_factory.mktemp("whole"))
    assert found() == ExitCode.DONE
    return found


def test_a_clear_difference_needs_few_seeds_and_none_needs_all(whole: Adaptive) -> None:
    for policy, ratio in (("uniform", 3.0), ("periodic", 0.4)):
        seeds, result = whole.result(policy)
        assert seeds <= 30
        assert result.endswith(", decided")
        assert float(result.split()[1].strip(",")) == pytest.approx(ratio, rel=0.4)
    assert whole.result("random")[0] == SEEDS
    assert whole.result("random")[1].endswith("not decided")
    assert whole.result("d_optimal") == (SEEDS, "reference")
    assert whole.report.endswith("2 of 3 comparisons decided")


def test_the_database_holds_the_seeds_of_the_report_and_nothing_is_left_pending(
    whole: Adaptive,
) -> None:
    for policy in FACTORS:
        seeds = [seed for name, seed, _ in whole.outcomes() if name == policy]
        assert seeds == list(range(whole.result(policy)[0]))
    assert {status for _, _, status in whole.outcomes()} == {"done"}


@pytest.mark.parametrize("trials", [0, 1, 40, 41, 79, 120, 140])
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


def test_trials_that_are_there_already_change_no_decision(
    adaptive: Adaptive, whole: Adaptive
) -> None:
    """Nor does the order in which they were run: here all seeds of all policies."""
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
def test_failed_and_diverged_trials_are_no_pairs_and_block_nothing(
    adaptive: Adaptive, fail: bool
) -> None:
    code = adaptive(partial(unlucky, fail=fail))
    assert code == (ExitCode.SOME_FAILED if fail else ExitCode.DONE)
    seeds, result = adaptive.result("uniform")
    assert seeds <= 40
    assert result.endswith(", decided")
    statuses = [status for name, _, status in adaptive.outcomes() if name == "uniform"]
    assert statuses.count("failed" if fail else "diverged") == seeds // 5
    assert adaptive.result("random")[0] == SEEDS


def test_a_policy_of_which_all_trials_fail_ends_with_all_seeds(adaptive: Adaptive) -> None:
    def broken(spec: TrialSpec) -> TrialResult:
        if spec.policy.name == "uniform":
            raise ZeroDivisionError("no trial of it works")
        return lossy(spec)

    assert adaptive(broken, of=grid(["d_optimal", "uniform"], 25)) == ExitCode.SOME_FAILED
    assert adaptive.result("uniform") == (25, "no ratio, not decided")


def test_fail_fast_starts_no_further_batch(adaptive: Adaptive) -> None:
    code = adaptive(partial(unlucky, fail=True), fail_fast=True)
    assert code == ExitCode.SOME_FAILED
    assert "stopped at the first failure" in adaptive.report
    assert max(seed for _, seed, _ in adaptive.outcomes()) < 10


def test_failed_trials_that_run_again_count(adaptive: Adaptive, whole: Adaptive) -> None:
    adaptive(partial(unlucky, fail=True))
    assert adaptive(retry="failed") == ExitCode.DONE
    assert adaptive.report == whole.report


def test_a_mean_that_is_known_needs_no_more_seeds(adaptive: Adaptive) -> None:
    of = grid(["random", "random_held"], seeds=40)
    assert adaptive(until=UntilPrecise(0.05), of=of) == ExitCode.DONE
    seeds, result = adaptive.result("random_held")
    assert seeds == 20
    match = re.fullmatch(r"mean (\S+) ± (\S+) %, known", result)
    assert match
    assert float(match[1]) == pytest.approx(1.0, abs=0.03)
    assert float(match[2]) < 5
    seeds, result = adaptive.result("random")
    assert seeds == 40
    assert result.endswith("%")
    assert adaptive.report.endswith("60 of 80 trials (75 %), 1 of 2 means known")


def test_only_shared_seeds_are_run(adaptive: Adaptive) -> None:
    """The reference has twenty seeds more, which no comparison needs."""
    own = [trial_of("random", seed) for seed in range(20)]
    other = [trial_of("d_optimal", seed) for seed in range(40)]
    assert adaptive(of=Grid([*own, *other], n_jobs=60, left_out={})) == ExitCode.DONE
    assert adaptive.result("random")[0] == 20
    assert adaptive.result("d_optimal") == (20, "reference")
