"""A launch brings every trial to an outcome, once, whatever happens to some of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from dopt.errors import SpecificationError, UnusableEnvironmentError
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import ExitCode
from orchestrate.runner.run_grid import Work, launch_grid
from orchestrate.store import NoDatabaseError, Reader, Store
from tests.orchestrate.conftest import RECORD, Launches
from tests.orchestrate.standins import (
    BROKEN_SEED,
    deadly,
    diverging,
    exiting,
    malformed,
    quick,
    raising,
    specification,
    unusable,
)


def test_the_same_command_again_runs_nothing_and_says_so(launches: Launches) -> None:
    assert launches(quick) == ExitCode.DONE
    assert "0 of 5 already done, 5 to run" in launches.said[0]
    assert launches(raising) == ExitCode.DONE
    assert "5 of 5 already done, nothing to run" in launches.said[-1]


def test_a_larger_grid_runs_only_what_is_new(launches: Launches) -> None:
    launches(quick, seeds=3)
    launches(quick, seeds=5)
    assert "3 of 5 already done, 2 to run" in launches.said[2]
    assert launches.query("SELECT launch_id, count(*) FROM trial GROUP BY 1 ORDER BY 1") == [
        (1, 3),
        (2, 2),
    ]


def test_the_whole_grid_is_registered_before_the_first_trial_runs(launches: Launches) -> None:
    seen: list[int] = []

    def look(spec: object) -> object:
        seen.append(launches.query("SELECT count(*) FROM trial")[0][0])
        return quick(spec)  # type: ignore[arg-type]

    launches(look, seeds=4)  # type: ignore[arg-type]
    assert seen == [4, 4, 4, 4]


def test_an_exception_is_recorded_and_the_grid_goes_on(launches: Launches) -> None:
    assert launches(raising) == ExitCode.SOME_FAILED
    assert launches.statuses() == {0: "done", 1: "done", 2: "failed", 3: "done", 4: "done"}
    assert "1 failed: ZeroDivisionError: the seed is broken" in launches.said[-1]
    [(cause, text)] = launches.query("SELECT cause, traceback FROM v_failures")
    assert cause == "exception"
    assert "in raising" in text


@pytest.mark.parametrize("executor", ["inprocess", "local"])
def test_a_trial_that_leaves_ends_neither_the_launch_nor_its_worker(
    launches: Launches, executor: str
) -> None:
    assert launches(exiting, executor=executor) == ExitCode.SOME_FAILED
    assert launches.statuses() == {0: "done", 1: "done", 2: "failed", 3: "done", 4: "done"}
    assert launches.query("SELECT cause, type FROM v_failures") == [("exception", "SystemExit")]


@pytest.mark.parametrize("executor", ["inprocess", "local"])
def test_what_no_trial_can_run_on_ends_the_launch_and_fails_no_trial(
    launches: Launches, executor: str
) -> None:
    with pytest.raises(UnusableEnvironmentError, match="no compiler: install one"):
        launches(unusable, executor=executor, workers=1)
    statuses = launches.statuses()  # a worker may have been a step ahead
    assert (statuses[1], statuses[BROKEN_SEED]) == ("done", "pending")
    assert set(statuses.values()) == {"done", "pending"}
    assert launches.query("SELECT state, exit_code FROM launch") == [("failed", 2)]
    assert not launches.query("SELECT * FROM v_failures")
    assert launches(quick, executor=executor) == ExitCode.DONE


def test_a_failure_is_tried_again_only_when_asked(launches: Launches) -> None:
    launches(raising)
    assert launches(quick) == ExitCode.SOME_FAILED
    assert launches.statuses()[BROKEN_SEED] == "failed"
    assert launches(quick, retry="diverged") == ExitCode.SOME_FAILED
    assert launches(quick, retry="failed") == ExitCode.DONE
    assert launches.statuses()[BROKEN_SEED] == "done"


def test_a_diverged_trial_is_a_result_that_is_kept(launches: Launches) -> None:
    assert launches(diverging) == ExitCode.DONE
    assert launches.statuses()[BROKEN_SEED] == "diverged"
    assert launches(quick) == ExitCode.DONE
    assert launches.statuses()[BROKEN_SEED] == "diverged"
    assert launches(quick, retry="all") == ExitCode.DONE
    assert launches.statuses()[BROKEN_SEED] == "done"


def test_fail_fast_stops_at_the_first_failure(launches: Launches) -> None:
    assert launches(raising, seeds=300, fail_fast=True) == ExitCode.SOME_FAILED
    left = launches.query("SELECT count(*) FROM trial WHERE status = 'pending'")[0][0]
    assert left > 50
    assert "stopped at the first failure" in launches.said[-1]


def test_a_malformed_result_fails_its_trial_only(launches: Launches) -> None:
    assert launches(malformed, executor="local") == ExitCode.SOME_FAILED
    assert launches.statuses() == {0: "done", 1: "done", 2: "failed", 3: "done", 4: "done"}
    assert launches.query("SELECT cause FROM v_failures") == [("malformed",)]


def test_a_trial_that_kills_its_worker_twice_alone_fails_and_no_other(launches: Launches) -> None:
    assert launches(deadly, seeds=12, executor="local") == ExitCode.SOME_FAILED
    statuses = launches.statuses()
    assert statuses.pop(BROKEN_SEED) == "failed"
    assert set(statuses.values()) == {"done"}
    assert launches.query("SELECT cause, type FROM v_failures") == [("killed", "WorkerLost")]


def test_rows_do_not_depend_on_the_executor(launches: Launches) -> None:
    launches(quick)
    here = launches.query("SELECT seed, t, loss FROM v_curve ORDER BY seed, t")
    launches.url = launches.url.replace("results.db", "other.db")
    launches(quick, executor="local", chunk_seconds=1e-9)
    assert launches.query("SELECT seed, t, loss FROM v_curve ORDER BY seed, t") == here


def test_the_trials_of_a_dead_launch_are_taken_over(launches: Launches) -> None:
    with Store.open(launches.url) as store:
        dead = store.begin_launch(RECORD)
        store.register(dead, [specification(0)])
        assert len(store.claim(dead, [specification(0).trial_key])) == 1
    assert launches(quick) == ExitCode.DONE
    assert set(launches.statuses().values()) == {"done"}


def test_a_launch_waits_for_the_trials_of_a_living_one(launches: Launches) -> None:
    with Store.open(launches.url) as store:
        other = store.begin_launch(RECORD)
        store.register(other, [specification(0)])
        [claim] = store.claim(other, [specification(0).trial_key])

        def finish(spec: object) -> object:
            if spec == specification(4):
                store.release(other, [claim.trial_key])
            return quick(spec)  # type: ignore[arg-type]

        assert launches(finish) == ExitCode.DONE  # type: ignore[arg-type]
    assert "1 running in another launch" in launches.said[0]
    assert launches.query("SELECT DISTINCT launch_id FROM trial") == [(2,)]
    assert set(launches.statuses().values()) == {"done"}


def test_the_launch_is_written_down_with_its_end(launches: Launches) -> None:
    launches(quick)
    launches(raising, seeds=6, executor="local")
    assert launches.query("SELECT state, host FROM launch") == [("done", "here"), ("done", "here")]


def test_nothing_is_made_for_a_wrong_grid(launches: Launches) -> None:
    with pytest.raises(SpecificationError):
        specification(0, mass=-1)
    with pytest.raises(NoDatabaseError):
        Reader.open(launches.url)


@pytest.mark.parametrize(("models", "prepared"), [(("in_torch",), 0), (("in_torch", "mlp"), 1)])
def test_the_kernel_is_made_ready_where_a_trial_needs_it(
    tmp_path: Path, models: tuple[str, ...], prepared: int
) -> None:
    calls: list[None] = []
    sections = {
        "in_torch": {"_target_": "tests.dopt.custom_networks.Stack"},
        "mlp": {"name": "mlp"},
    }
    usual = specification().to_mapping()
    trials = [
        TrialSpec.from_mapping({k: v for k, v in usual.items() if k != "path"} | {"model": chosen})
        for chosen in (sections[name] for name in models)
    ]
    grid = Grid(trials, n_jobs=len(trials), left_out={})
    settings = LaunchSettings("inprocess", f"sqlite:///{tmp_path / 'results.db'}")
    work = Work(quick, prepare=lambda: calls.append(None))
    assert launch_grid(grid, settings, RECORD, work, lambda _: None, stream=None) == ExitCode.DONE
    assert len(calls) == prepared
