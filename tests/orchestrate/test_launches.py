"""The trials themselves, not stand-ins, through every executor: the same rows."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from dopt.errors import SpecificationError
from dopt.run import run_trial
from dopt.spec.config import without_versions
from dopt.spec.trial import TrialSpec
from orchestrate import launch
from orchestrate.__main__ import main
from orchestrate.config import Combination, Grid, build_grid
from orchestrate.config.launch_settings import LaunchSettings, Share, share
from orchestrate.errors import ExitCode, LaunchError
from orchestrate.runner.start import Work, collected, launch_grid
from orchestrate.store import NoDatabaseError, Reader, Store, StoreError
from orchestrate.store.maintenance import collect, examine, merge_collected
from tests.orchestrate.conftest import RECORD
from tests.orchestrate.faults.laboratory import flaws, results
from tests.orchestrate.standins import grid_of, specification
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result
from tests.paths import ROOT
from tests.waiting import until


def words(executor: str, url: str) -> list[str]:
    """Return the words that launch two short trials of two systems, one of which changes."""
    grid = ["-m", "env=pendulum,beyond/drifting_pendulum", "policy=d_optimal", "seed=range(2)"]
    return [*grid, "env.horizon=12", f"executor={executor}", f"store.url={url}"]


def losses(url: str) -> list[float]:
    with Reader.open(url) as reader:
        configs = sorted(reader.configs(), key=lambda config: config.config_key)
        return [
            float(loss)
            for config in configs
            for loss in reader.curves(config.config_key).values.ravel().tolist()
        ]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> list[float]:
    """Return the losses of the trials one after the other in this process."""
    url = f"sqlite:///{tmp_path_factory.mktemp('alone') / 'results.db'}"
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DOPT_DB", raising=False)
        patch.setattr(sys, "argv", ["launch.py", *words("inprocess", url)])
        assert launch.main() == 0
    return losses(url)


@pytest.mark.parametrize("executor", ["local", "ray"])
@pytest.mark.xdist_group("real trials")  # one run in one process for all of them
def test_every_executor_stores_the_same_losses(
    executor: str, alone: list[float], tmp_path: Path
) -> None:
    url = f"sqlite:///{tmp_path / executor}.db"
    done = subprocess.run(
        [sys.executable, "orchestrate/launch.py", *words(executor, url)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(alone) == 48
    assert losses(url) == alone


SHORT = {
    "name": "control",
    "checkpoints": [3],
    "steps": 12,
    "settle_steps": 2,
    "samples": 8,
    "elites": 2,
    "lookahead": 3,
    "free_run_steps": 4,
}


def grid(task: object, seeds: int) -> Grid:
    settings = {**specification(0).to_mapping(), "task": task}
    return build_grid([Combination(settings, seeds=range(seeds))])


def launched(folder: Path, executor: str, trials: Grid) -> str:
    """Run a grid of real trials into a database of its own; return its URL."""
    url = f"sqlite:///{folder / executor}.db"
    settings = LaunchSettings(executor=executor, store_url=url, workers=2)
    work = Work(run_trial)
    code = launch_grid(trials, settings, RECORD, work, lambda _: None, stream=None)
    assert code is ExitCode.DONE
    return url


def rows(url: str) -> list[tuple[object, ...]]:
    with Reader.open(url) as reader:
        sql = "SELECT seed, t, measure, value FROM v_assessment ORDER BY seed, t, measure"
        return [tuple(row) for row in reader.rows(sql)]


def test_the_rows_do_not_depend_on_the_executor(tmp_path: Path) -> None:
    trials = grid(SHORT, seeds=3)
    alone = launched(tmp_path, "inprocess", trials)
    assert len(rows(alone)) == 3 * (2 + 4 * 3)
    assert rows(launched(tmp_path, "local", trials)) == rows(alone)
    assert [one for one in examine(alone) if one.severity == "error"] == []
    with Reader.open(alone) as reader:
        (config,) = reader.configs()
    again = TrialSpec.from_mapping(without_versions(config.config))
    assert [trial.trial_key for trial in trials.trials][:1] == [again.trial_key]


def test_a_task_of_none_is_no_task() -> None:
    keys = [trial.trial_key for trial in grid({"name": "none"}, seeds=2).trials]
    assert keys == [specification(seed).trial_key for seed in range(2)]


def test_a_checkpoint_beyond_the_end_stops_before_anything_runs() -> None:
    with pytest.raises(SpecificationError, match="step 9, but a trial has 5 steps"):
        grid({**SHORT, "checkpoints": [9]}, seeds=1)


GRID = ("-m", "policy=random", "seed=range(20)", "env.horizon=5", "executor=inprocess")
SHARES = 3

Launch = Callable[..., tuple[int, str, str]]


@pytest.fixture
def launch_share(command_line: Launch, tmp_path: Path) -> Callable[..., str]:
    """Return a function that runs one share, on a disk of its own, and tells what it said."""

    def run(number: int, *more: str) -> str:
        url = f"store.url=sqlite:///{tmp_path}/disk-{number}/s.db"
        folder = f"store.folder={tmp_path}/shared"
        code, said, err = command_line(
            *GRID, "store=shards", url, folder, f"launch.share={number}/{SHARES}", *more
        )
        assert code == 0, err
        return said

    return run


def trials(url: str) -> list[tuple[object, ...]]:
    with Reader.open(url) as reader:
        return sorted(map(tuple, reader.rows("SELECT trial_key, final_loss, status FROM trial")))


def test_merged_shares_are_the_rows_of_one_database(
    launch_share: Callable[..., str], command_line: Launch, tmp_path: Path
) -> None:
    for number in range(1, SHARES + 1):
        launch_share(number)
    one, merged = f"sqlite:///{tmp_path}/one.db", f"sqlite:///{tmp_path}/merged.db"
    assert command_line(*GRID, f"store.url={one}")[0] == 0
    assert main(["merge", f"{tmp_path}/shared", "--db", merged]) == 0
    assert trials(merged) == trials(one)
    assert results(merged) == results(one)
    assert flaws(merged) == []


def test_a_share_goes_on_on_another_machine(
    launch_share: Callable[..., str], tmp_path: Path
) -> None:
    launch_share(1, "seed=range(12)")
    shutil.rmtree(tmp_path / "disk-1")
    [copy] = (tmp_path / "shared").glob("s.1-of-3.*.db")
    copy.rename(copy.with_name("s.1-of-3.elsewhere.db"))
    done = len(trials(f"sqlite:///{tmp_path}/shared/s.1-of-3.elsewhere.db"))
    assert done > 0
    assert f"{done} of " in launch_share(1)


def test_shares_are_disjoint_and_complete() -> None:
    keys = [trial.trial_key for trial in grid_of(["random", "uniform"], seeds=50).trials]
    shares = [Share(number, 7) for number in range(1, 8)]
    assert [sum(one.holds(key) for one in shares) for key in keys] == [1] * len(keys)


@pytest.mark.parametrize("given", ["0/3", "4/3", "3", "a/b", 3, "1/0"])
def test_a_wrong_share_is_refused(given: object) -> None:
    with pytest.raises(LaunchError, match="such as 3/20"):
        share(given)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ((*GRID, "store=shards"), "launch.share is None"),
        ((*GRID, "store=shards", "launch.share=1/2", "store.url=postgresql://x/y"), "x.db"),
        (("env=pendulum", "launch.share=1/2"), "launch.share is for grids"),
        ((*GRID, "launch.share=1/2", "launch.detach=true"), "takes a part of it"),
        (("env=pendulum", "launch.detach=true"), "launch.detach is for grids"),
        ((*GRID, "launch.detach=true", "launch.until=ci<5%"), "leave one of the two out"),
    ],
)
def test_what_does_not_go_with_shares_or_leaving_is_refused(
    command_line: Launch, words: tuple[str, ...], named: str
) -> None:
    code, _, err = command_line(*words)
    assert code == 2
    assert named in err


def test_copies_are_made_while_trials_run(tmp_path: Path) -> None:
    url, shared = f"sqlite:///{tmp_path}/s.1-of-2.here.db", tmp_path / "shared"
    settings = LaunchSettings(
        "local", url, share=Share(1, 2), collect_in=shared, collect_seconds=0.05
    )
    with Store.open(url) as store, collected(settings, print):
        launch = store.begin_launch(LAUNCH)
        for claim in store.claim(launch, store.register(launch, [Spec(0)]).todo):
            store.commit(claim, result(), RUN)
        until(lambda: copied(tmp_path, shared) == 1)
        store.end_launch(launch, "done")
    assert [path.name for path in shared.iterdir()] == ["s.1-of-2.here.db"]


def copied(tmp_path: Path, shared: Path) -> int:
    """Merge what is collected so far, as one may at any moment, and count it."""
    merged = f"sqlite:///{tmp_path}/so-far.db"
    try:
        for _ in merge_collected(merged, shared):
            pass
        return len(trials(merged))
    except NoDatabaseError:
        return 0


def test_a_copy_that_cannot_be_made_leaves_the_earlier_one(tmp_path: Path) -> None:
    url, shared = f"sqlite:///{tmp_path}/s.1-of-2.here.db", tmp_path / "shared"
    with Store.open(url) as store:
        store.register(store.begin_launch(LAUNCH), [Spec(0)])
    collect(url, shared)
    (tmp_path / "s.1-of-2.here.db").write_bytes(b"no database any more" * 1000)
    with pytest.raises(StoreError):
        collect(url, shared)
    assert len(trials(f"sqlite:///{shared}/s.1-of-2.here.db")) == 1
