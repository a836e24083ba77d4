"""``work``: the command line of a worker, and a launch that leaves its grid to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from dopt.spec.trial import TrialSpec
from orchestrate.__main__ import main
from orchestrate.executors.base import Event, Task
from orchestrate.executors.inprocess import InProcessExecutor
from orchestrate.fingerprint import fingerprint
from orchestrate.program import UsageError, length_of_time
from orchestrate.runner import worker
from orchestrate.runner.run_grid import Work
from orchestrate.store import Claim, LaunchRecord, Store
from tests.orchestrate.runner.test_scheduler import Scripted, finish, keys
from tests.orchestrate.standins import quick, raising, unusable
from tests.orchestrate.standins import trial_of as short_trial
from tests.orchestrate.store.places import execute

GRID = ("-m", "env=pendulum", "policy=random,uniform", "seed=range(3)", "env.horizon=5")
LEAVE = "launch.detach=true"

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def pull(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Run:
    """Return a function that runs commands, and trials of stand-ins in this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DOPT_DB", raising=False)
    monkeypatch.setattr(worker, "WORK", Work(raising, prepare=lambda: None))
    monkeypatch.setattr(worker, "make_executor", lambda _, run: InProcessExecutor(run))

    def run(*words: str) -> tuple[int, str, str]:
        code = main(words)
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return run


def test_a_launch_leaves_its_grid_to_workers(command_line: Run, pull: Run) -> None:
    code, said, _ = command_line(*GRID, LEAVE)
    assert code == 0
    assert "0 of 6 already done, 6 registered; start workers with" in said
    _, out, _ = pull("status")
    assert "registered a grid for workers" in out
    assert "No worker is running: start workers with python -m orchestrate work" in out
    code, out, _ = pull("work", "--until", "5m")
    assert (code, out.splitlines()[0].split(",")[0]) == (1, "6 trials wait")
    assert "4 trials done, 0 of them diverged, 2 failed" in out
    assert "2 failed: ZeroDivisionError" in out
    assert pull("work")[0] == 0
    assert "registered a grid for workers" not in pull("status")[1]


def test_a_worker_that_can_run_no_trial_hands_back_what_it_holds(
    command_line: Run, pull: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    command_line(*GRID, LEAVE)
    monkeypatch.setattr(worker, "WORK", Work(unusable, prepare=lambda: None))
    code, _, errors = pull("work", "--processes", "1")
    assert (code, errors.splitlines()[-1]) == (2, "error: the machine has no compiler: install one")
    monkeypatch.setattr(worker, "WORK", Work(quick, prepare=lambda: None))
    assert pull("work")[0] == 0


def test_results_that_come_too_late_are_counted(
    command_line: Run, pull: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    command_line(*GRID, LEAVE)
    commit = Store.commit_many

    def late(store: Store, results: Sequence[tuple[Claim, object, object]]) -> list[bool]:
        store.release(results[0][0].launch)
        return commit(store, results)  # type: ignore[arg-type]

    calls = iter([late])
    monkeypatch.setattr(Store, "commit_many", lambda *words: next(calls, commit)(*words))
    _, out, _ = pull("work")
    assert "results refused: the lease had run out" in out
    assert "4 trials done" in out


def test_a_trial_that_was_taken_away_is_not_run_twice_at_once(
    command_line: Run, pull: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its lease had run out while it ran here, and it waits in the database again."""
    command_line(*GRID, LEAVE)

    def fate(chunk: Sequence[Task], _: int) -> list[Event]:
        executor.held -= {*keys(chunk)}
        if executor.held and len(executor.given) <= 3:
            with Store.open(f"sqlite:///{tmp_path}/results/results.db") as other:
                other.release(2)
        return finish(chunk)

    class Watched(Scripted):
        held = frozenset[str]()

        def start(self) -> None:
            self.slots = 1

        def submit(self, chunk: Sequence[Task]) -> None:
            super().submit(chunk)
            assert self.held.isdisjoint(keys(chunk))
            self.held |= {*keys(chunk)}

    executor = Watched(fate)
    monkeypatch.setattr(worker, "make_executor", lambda *_: executor)
    code, out, _ = pull("work")
    assert "results refused: the lease had run out" in out
    assert "6 trials done" in out
    assert code == 0


def test_a_launch_that_left_and_is_repeated_says_what_is_done(command_line: Run, pull: Run) -> None:
    command_line(*GRID, LEAVE)
    pull("work")
    _, said, _ = command_line(*GRID, LEAVE, "launch.retry=failed")
    assert "4 of 6 already done, 2 registered" in said


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("env=pendulum", LEAVE), "launch.detach is for grids"),
        ((*GRID, LEAVE, "launch.until=ci<5%"), "leave one of the two out"),
    ],
)
def test_what_does_not_go_with_leaving_is_refused(
    command_line: Run, words: tuple[str, ...], named: str
) -> None:
    code, _, err = command_line(*words)
    assert code == 2
    assert named in err


def test_a_worker_ends_when_the_rest_cannot_run_here(
    command_line: Run, pull: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    command_line(*GRID, LEAVE)
    monkeypatch.setattr("orchestrate.runner.worker.memory_of_this_machine", lambda: 10)
    code, out, err = pull("work")
    assert code == 3
    assert "6 left" in out
    assert "3 trials are left to other workers" in err


def test_a_worker_makes_no_database(pull: Run, tmp_path: Path) -> None:
    code, _, err = pull("work")
    assert code == 2
    assert "error: " in err
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    ("given", "seconds"),
    [("55m", 3300.0), ("1h30m", 5400.0), ("90", 90.0), ("0.5s", 0.5), ("2d", 172_800.0)],
)
def test_a_length_of_time(given: str, seconds: float) -> None:
    assert length_of_time("--until")(given) == seconds


@pytest.mark.parametrize("given", ["", "m", "5x", "-3m", "0"])
def test_a_wrong_length_of_time_is_refused(given: str) -> None:
    with pytest.raises(UsageError, match="such as 55m"):
        length_of_time("--until")(given)


def test_every_trial_is_rebuilt_as_it_was_registered(command_line: Run, pull: Run) -> None:
    ran: list[TrialSpec] = []

    def run(spec: TrialSpec) -> object:
        ran.append(spec)
        return raising(spec)

    worker.WORK = Work(run, prepare=lambda: None)  # type: ignore[arg-type]
    command_line(*GRID, LEAVE)
    pull("work")
    assert len({spec.trial_key for spec in ran}) == 6
    _, out, _ = pull("query", "SELECT trial_key FROM trial", "--json")
    assert all(spec.trial_key in out for spec in ran)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ("--retry-memory", "2"),
            "is 2, but there is no limit that it could raise: set --memory-gib",
        ),
        (
            ("--retry-memory", "1", "--memory-gib", "1"),
            "is 1.0, but null or a factor above 1, at most 100, is expected",
        ),
    ],
)
def test_a_factor_of_memory_needs_a_limit_and_raises_it(
    command_line: Run, pull: Run, words: Sequence[str], sentence: str
) -> None:
    command_line(*GRID, LEAVE)
    code, _, errors = pull("work", *words)
    assert code == 2
    assert sentence in errors


DONE = "SELECT count(*) AS n FROM trial WHERE status = 'done'"


@pytest.fixture
def code(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Return a function after which launches and workers of this process run other code."""

    def change(digest: str) -> None:
        changed = {**fingerprint(), "code of dopt": digest}
        monkeypatch.setattr("orchestrate.runner.saving.fingerprint", lambda: changed)
        monkeypatch.setattr("orchestrate.runner.worker.fingerprint", lambda: changed)

    return change


def test_a_worker_leaves_trials_that_other_code_has_registered(
    command_line: Run, pull: Run, code: Callable[[str], None]
) -> None:
    code("aaaa")
    command_line(*GRID, LEAVE)
    code("bbbb")
    left, out, err = pull("work")
    assert left == 3
    assert "0 trials wait" in out
    assert err.count("6 trials are left, which other code has registered") == 1
    assert "(the code of dopt is aaaa there and bbbb here): run a worker with that code, or" in err
    assert "0" in pull("query", DONE)[1]
    command_line(*GRID, LEAVE)  # the same command with the code of the worker
    assert pull("work")[0] == 1
    assert "4" in pull("query", DONE)[1]
    assert "different code" not in pull("status")[1]


def test_a_grid_of_an_older_program_waits_for_its_launch_command(
    command_line: Run, pull: Run, tmp_path: Path
) -> None:
    command_line(*GRID, LEAVE)
    execute(f"sqlite:///{tmp_path}/results/results.db", "UPDATE launch SET fingerprint = NULL")
    left, _, err = pull("work")
    assert left == 3
    assert "6 trials are left, which other code has registered (an older program): run" in err
    command_line(*GRID, LEAVE)
    assert pull("work")[0] == 1


def test_trials_of_two_codes_go_to_the_workers_of_each(
    command_line: Run, pull: Run, code: Callable[[str], None]
) -> None:
    code("aaaa")
    command_line(*GRID, LEAVE)
    code("bbbb")
    command_line(*GRID[:-2], "seed=range(1)", GRID[-1], LEAVE)
    assert pull("work")[0] == 3
    assert "2" in pull("query", DONE)[1]
    code("aaaa")
    assert pull("work")[0] == 1
    assert "4" in pull("query", DONE)[1]
    assert "2 configurations with results of different code" in pull("status")[1]
    found = pull("doctor")[1]
    assert "results of code or libraries with different fingerprints: 2" in found
    rows = pull("query", "SELECT trial_key FROM trial WHERE status = 'done'", "--json")[1]
    code("cccc")
    command_line(*GRID, LEAVE)
    pull("work")
    assert pull("query", "SELECT trial_key FROM trial WHERE status = 'done'", "--json")[1] == rows


def test_a_claim_leaves_what_was_taken_over_since_it_was_looked_for(tmp_path: Path) -> None:
    spec = short_trial("random", seed=0)
    with Store.open(f"sqlite:///{tmp_path}/results.db") as store:
        old, new = (
            store.begin_launch(LaunchRecord([], [], "here", 1, fingerprint={"code": digest}))
            for digest in "ab"
        )
        keys = store.register(old, [spec]).todo
        store.register(new, [spec])
        assert store.claim(old, keys, alike=True) == []
        assert len(store.claim(new, keys, alike=True)) == 1
