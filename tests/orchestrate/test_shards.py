"""Shares of a grid in databases of their own, collected in a folder and merged."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from orchestrate.__main__ import main
from orchestrate.config.launch_settings import LaunchSettings, Share, share
from orchestrate.errors import LaunchError
from orchestrate.runner.run_grid import collected
from orchestrate.store import NoDatabaseError, Reader, Store, StoreError
from orchestrate.store.maintenance import collect, merge_collected
from tests.orchestrate.faults.laboratory import flaws, results
from tests.orchestrate.standins import grid_of
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, result
from tests.waiting import until

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
        return sorted(map(tuple, reader.query("SELECT trial_key, final_loss, status FROM trial")))


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
    ],
)
def test_what_does_not_go_with_shares_is_refused(
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
