"""A launch brings every trial to an outcome, once, whatever happens to some of them."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from dopt.errors import UnusableEnvironmentError
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from orchestrate.config import Grid, LaunchSettings
from orchestrate.errors import ExitCode, InfrastructureError
from orchestrate.executors.base import Event, Executor, Task, WorkerLost, run_task
from orchestrate.runner.scheduler import MAX_LONE_LOSSES, MAX_WORKER_LOSSES, SUSPECT_LOSSES
from orchestrate.runner.start import Output, Work, launch_grid
from orchestrate.store import Claim, Store, StoreUnavailableError
from orchestrate.store.records import utc_text
from tests.orchestrate.conftest import RECORD, Launches
from tests.orchestrate.losses import lose
from tests.orchestrate.standins import (
    BROKEN_SEED,
    diverging,
    quick,
    raising,
    specification,
    unusable,
)


def test_a_larger_grid_runs_only_what_is_new(launches: Launches) -> None:
    launches(quick, seeds=3)
    launches(quick, seeds=5)
    assert "3 of 5 already done, 2 to run" in launches.said[2]
    found = launches.query("SELECT launch_id, count(*) FROM trial GROUP BY 1 ORDER BY 1")
    assert found == [(1, 3), (2, 2)]


def test_the_whole_grid_is_registered_before_the_first_trial_runs(launches: Launches) -> None:
    seen: list[int] = []

    def look(spec: object) -> object:
        seen.append(launches.query("SELECT count(*) FROM trial")[0][0])
        return quick(spec)  # type: ignore[arg-type]

    launches(look, seeds=4)  # type: ignore[arg-type]
    assert seen == [4, 4, 4, 4]


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


@pytest.mark.parametrize(("models", "prepared"), [(("in_torch",), 0), (("in_torch", "mlp"), 1)])
def test_the_kernel_is_made_ready_where_a_trial_needs_it(
    tmp_path: Path, models: tuple[str, ...], prepared: int
) -> None:
    calls: list[Sequence[TrialConfig]] = []

    def prepare(configs: Sequence[TrialConfig]) -> AbstractContextManager[None]:
        calls.append(configs)
        return nullcontext()

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
    work = Work(quick, prepare)
    assert launch_grid(grid, settings, RECORD, work, Output(print, print)) == ExitCode.DONE
    assert sum(map(len, calls)) == prepared


Fate = Callable[[Sequence[Task], int], list[Event]]
"""Fate of a chunk, whose first trial is submitted for the given time: 1, 2 ..."""


class Scripted(Executor):
    """Lets each chunk end as the script says, and keeps what it was given."""

    def __init__(self, fate: Fate) -> None:
        self._fate = fate
        self._chunks: deque[Sequence[Task]] = deque()
        self._times: Counter[str] = Counter()
        self.given: list[list[int]] = []

    def start(self) -> None:
        self.slots = 4

    def submit(self, chunk: Sequence[Task]) -> None:
        if chunk:
            self._chunks.append(chunk)
            self.given.append([task.spec.seed for task in chunk])

    def wait(self, timeout: float) -> list[Event]:  # noqa: ARG002  # the interface's
        if not self._chunks:
            return []
        chunk = self._chunks.popleft()
        self._times.update(task.key for task in chunk)
        return self._fate(chunk, self._times[chunk[0].key])

    @property
    def pending(self) -> int:
        return len(self._chunks)

    def stop(self) -> None:
        self._chunks.clear()


@pytest.fixture
def scripted(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[ExitCode, Scripted]]:
    """Return a function that launches a grid on a scripted executor."""

    def launch(fate: Fate, seeds: int = 5, **settings: object) -> tuple[ExitCode, Scripted]:
        executor = Scripted(fate)
        monkeypatch.setattr("orchestrate.runner.start.make_executor", lambda *_: executor)
        return launches(seeds=seeds, **settings), executor  # type: ignore[arg-type]

    return launch


def finish(chunk: Sequence[Task]) -> list[Event]:
    return [run_task(quick, task) for task in chunk]


def keys(chunk: Sequence[Task]) -> tuple[str, ...]:
    return tuple(task.key for task in chunk)


def has_broken(chunk: Sequence[Task]) -> bool:
    return BROKEN_SEED in [task.spec.seed for task in chunk]


Launch = Callable[..., tuple[ExitCode, Scripted]]


def loses_nodes(times: int, only: Callable[[int], bool] = lambda _: True) -> Fate:
    """Return the fate of a trial that loses its node so often, or its process at other times."""

    def fate(chunk: Sequence[Task], time: int) -> list[Event]:
        if has_broken(chunk) and time <= times:
            return [WorkerLost(keys(chunk), "lost its power", node_lost=only(time))]
        return finish(chunk)

    return fate


def test_a_trial_whose_node_is_lost_runs_again_free_of_charge(
    scripted: Launch, launches: Launches
) -> None:
    losses = MAX_LONE_LOSSES - 1
    assert losses > SUSPECT_LOSSES
    assert scripted(loses_nodes(losses))[0] == ExitCode.DONE
    assert set(launches.statuses().values()) == {"done"}
    outcomes = launches.query(
        "SELECT outcome, count(*) FROM attempt JOIN trial USING (trial_id) "
        f"WHERE seed = {BROKEN_SEED} GROUP BY outcome ORDER BY outcome"
    )
    assert outcomes == [("done", 1), ("released", losses)]


@pytest.mark.parametrize("hours", [-3, 3])
def test_times_are_those_of_the_clock_of_the_launch(
    scripted: Launch, launches: Launches, hours: int
) -> None:
    """The clock of the machine that runs the trials is some hours off."""
    off = timedelta(hours=hours)

    def fate(chunk: Sequence[Task], _: int) -> list[Event]:
        done = [run_task(quick, task) for task in chunk]
        times = [{"started": one.run.started + off, "ended": one.run.ended + off} for one in done]
        return [
            replace(one, run=replace(one.run, node="elsewhere", **both))
            for one, both in zip(done, times, strict=True)
        ]

    assert scripted(fate)[0] == ExitCode.DONE
    now = utc_text(datetime.now(UTC))
    rows = launches.query("SELECT claimed, started, ended, node FROM attempt")
    assert rows
    for claimed, started, ended, node in rows:
        assert claimed <= started <= ended <= now
        assert node == "elsewhere"


def test_a_trial_that_takes_every_node_down_runs_last_and_is_given_up(
    scripted: Launch, launches: Launches
) -> None:
    code, executor = scripted(loses_nodes(10**6))
    assert code == ExitCode.SOME_FAILED
    statuses = launches.statuses()
    assert statuses.pop(BROKEN_SEED) == "failed"
    assert set(statuses.values()) == {"done"}
    assert executor.given[-MAX_LONE_LOSSES + 1 :] == (MAX_LONE_LOSSES - 1) * [[BROKEN_SEED]]
    assert launches.query("SELECT cause, message FROM v_failures") == [
        (
            "node lost",
            f"node was lost {MAX_LONE_LOSSES} times while running only this trial "
            "(last: lost its power)",
        )
    ]


def test_the_loss_of_nodes_does_not_count_against_the_attempts(
    scripted: Launch, launches: Launches
) -> None:
    assert scripted(loses_nodes(MAX_LONE_LOSSES, lambda time: time != 2))[0] == ExitCode.DONE
    assert set(launches.statuses().values()) == {"done"}


def test_a_lost_chunk_is_split_and_only_the_one_to_blame_fails(
    scripted: Launch, launches: Launches
) -> None:
    def fate(chunk: Sequence[Task], _: int) -> list[Event]:
        if has_broken(chunk):
            return [WorkerLost(keys(chunk), "killed", cause="out of memory")]
        return finish(chunk)

    code, executor = scripted(fate, seeds=200)
    assert code == ExitCode.SOME_FAILED
    [(cause, kind)] = launches.query("SELECT cause, type FROM v_failures")
    assert (cause, kind) == ("out of memory", "WorkerLost")
    assert executor.given.count([BROKEN_SEED]) >= MAX_WORKER_LOSSES
    assert set(Counter(launches.statuses().values()).items()) == {("done", 199), ("failed", 1)}


def hangs(chunk: Sequence[Task], _: int) -> list[Event]:
    if has_broken(chunk):
        return [WorkerLost(keys(chunk), "timeout after 5 s", cause="timeout", traceback="in C")]
    return finish(chunk)


def test_a_timeout_is_final(scripted: Launch, launches: Launches) -> None:
    code, executor = scripted(hangs)
    assert code == ExitCode.SOME_FAILED
    assert executor.given.count([BROKEN_SEED]) == 1
    assert launches.query("SELECT cause, message, traceback FROM v_failures") == [
        ("timeout", "timeout after 5 s", "in C")
    ]
    assert "1 failed: timeout after 5 s" in launches.said[-1]


@pytest.mark.parametrize("cause", ["timeout", "exception"])
def test_fail_fast_heeds_every_cause(scripted: Launch, launches: Launches, cause: str) -> None:
    settings = {"seeds": 100, "fail_fast": True}
    code = scripted(hangs, **settings)[0] if cause == "timeout" else launches(raising, **settings)
    assert code == ExitCode.SOME_FAILED
    assert list(launches.statuses().values()).count("pending") > 20
    assert "stopped at the first failure" in launches.said[-1]


def breaks(chunk: Sequence[Task], _: int) -> list[Event]:
    if has_broken(chunk):
        raise InfrastructureError("The workers are gone: run the same command again.")
    return finish(chunk)


def test_the_end_of_the_executor_frees_the_claims_at_once(
    scripted: Launch, launches: Launches
) -> None:
    with pytest.raises(InfrastructureError, match="workers are gone"):
        scripted(breaks, seeds=50)
    statuses = Counter(launches.statuses().values())
    assert statuses["running"] == statuses["failed"] == 0
    assert statuses["pending"] > 0
    assert launches.query("SELECT state, exit_code FROM launch") == [("failed", 75)]
    assert scripted(lambda chunk, _: finish(chunk), seeds=50)[0] == ExitCode.DONE


def test_the_first_error_is_the_one_that_is_told(
    scripted: Launch, monkeypatch: pytest.MonkeyPatch
) -> None:
    lose(monkeypatch, ["question"] * 9, ["end_launch"], transient=False)
    with pytest.raises(InfrastructureError, match="workers are gone"):
        scripted(breaks)


def test_a_full_disk_ends_the_launch_at_once_and_charges_nobody(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        lose(patch, ["", "question"], ["commit_many"], transient=False)
        with pytest.raises(StoreUnavailableError, match="commit_many was lost"):
            launches(quick)
    assert sorted(launches.statuses().values()) == ["done"] + 4 * ["pending"]
    assert launches(quick) == ExitCode.DONE


def test_a_database_that_stays_away_ends_the_launch_and_a_rerun_completes(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        lose(patch, ["", ""] + 1000 * ["question"], ["commit_many", "end_launch"])
        with pytest.raises(StoreUnavailableError, match="commit_many was lost"):
            launches(quick, patience=0.5)
    assert launches.said[-1].startswith("waiting for up to 0.5 s: commit_many was lost")
    assert launches(quick) == ExitCode.DONE
    assert set(launches.statuses().values()) == {"done"}


def test_lost_questions_and_answers_cost_a_launch_nothing(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orchestrate.runner.saving.FIRST_PAUSE_SECONDS", 0.01)
    lose(monkeypatch, 8 * ["answer", "", "question", "answer", "", ""])
    assert launches(raising, seeds=20) == ExitCode.SOME_FAILED
    statuses = launches.statuses()
    assert statuses.pop(BROKEN_SEED) == "failed"
    assert set(statuses.values()) == {"done"}
    assert launches.said[-1].splitlines()[0].startswith("19 of 20 done, 1 failed, 0 diverged now")
    assert "1 failed: ZeroDivisionError" in launches.said[-1]
    assert launches.query("SELECT count(*) FROM attempt WHERE outcome IS NULL") == [(0,)]


def test_a_failure_that_is_refused_is_another_launchs_to_count(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail = Store.fail

    def late(store: Store, claim: object, *rest: object) -> bool:
        store.release(claim.launch)  # type: ignore[attr-defined]
        return fail(store, claim, *rest)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        calls = iter([late])
        patch.setattr(Store, "fail", lambda *words: next(calls, fail)(*words))
        assert launches(raising) == ExitCode.SOME_FAILED
    assert launches.statuses()[BROKEN_SEED] == "failed"
    assert launches.query("SELECT attempt FROM v_failures") == [(2,)]


def test_a_claim_that_is_done_after_it_was_repeated_is_found_again(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim, calls = Store.claim, iter(["lost", "outrun"])

    def outrun(store: Store, launch: int, wanted: Sequence[str]) -> list[Claim]:
        """Lose the first question, and answer the second one before the first is carried out."""
        call = next(calls, "")
        if call == "lost":
            raise StoreUnavailableError("claim was lost.", transient=True)
        claims = claim(store, launch, wanted)
        return [] if call == "outrun" else claims

    with monkeypatch.context() as patch:
        patch.setattr(Store, "claim", outrun)
        assert launches(quick) == ExitCode.DONE
    assert set(launches.statuses().values()) == {"done"}
    assert launches.query("SELECT count(*) FROM attempt WHERE outcome = 'released'") == [(1,)]


def test_trials_that_nobody_may_claim_are_not_asked_for_all_the_time(
    launches: Launches, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim, register, calls = Store.claim, Store.register, Counter[str]()
    start = time.monotonic()

    def locked(store: Store, launch: int, wanted: Sequence[str]) -> list[Claim]:
        return [] if time.monotonic() < start + 2.0 else claim(store, launch, wanted)

    def counted(store: Store, *words: object) -> object:
        calls["register"] += 1
        return register(store, *words)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(Store, "claim", locked)
        patch.setattr(Store, "register", counted)
        assert launches(quick) == ExitCode.DONE
    assert calls["register"] <= 6
