"""Chunks of trials, of a launch and of the database; the memory that they need."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dopt.errors import DoptError
from dopt.spec.trial import TrialSpec
from orchestrate.config import Combination, Grid, LaunchSettings, build_grid
from orchestrate.errors import LaunchError
from orchestrate.executors.limits import BYTES_PER_GIB
from orchestrate.records import RunRecord
from orchestrate.runner.saving import Patience, RetryingStore
from orchestrate.runner.scheduler import (
    MAX_CHUNK_TRIALS,
    Chunks,
    check_memory,
    memory_of_this_machine,
)
from orchestrate.runner.worker import StoredChunks, trial_of
from orchestrate.store import LaunchRecord, OpenConfig, Store
from tests.orchestrate.faults.trials import outcome
from tests.orchestrate.standins import specification
from tests.orchestrate.standins import trial_of as short_trial
from tests.orchestrate.store.fakes import RUN

TRIALS = [specification(seed) for seed in range(1000)]


def chunks(trials: list[TrialSpec] = TRIALS, cost: float | None = None) -> Chunks:
    """Return the queue of trials of which one has taken ``cost`` seconds."""
    known = Chunks(trials, seconds=1.0, slots=2)
    if cost is not None:
        known.observe(TRIALS[0].config_key, cost)
    return known


def given(queue: Chunks) -> list[list[TrialSpec]]:
    """Return the trials of every chunk."""
    found = []
    while len(queue):
        found.append([task.spec for task in queue.next()])
    return found


@pytest.mark.parametrize(("cost", "size"), [(None, 1), (0.1, 10), (30.0, 1)])
def test_a_chunk_holds_the_wanted_seconds(cost: float | None, size: int) -> None:
    assert len(chunks(cost=cost).next()) == size


def test_cheap_trials_are_bounded_get_fewer_and_keep_their_order() -> None:
    assert list(itertools.chain(*given(chunks(TRIALS[:50], 0.2)))) == TRIALS[:50]
    sizes = [len(chunk) for chunk in given(chunks(cost=1e-6))]
    assert sum(sizes) == len(TRIALS)
    assert max(sizes) == MAX_CHUNK_TRIALS
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] == 1


def test_a_lost_trial_comes_first_and_alone() -> None:
    known = chunks(TRIALS[:50], 1e-3)
    known.add(TRIALS[50:52], alone=True)
    assert len(known) == 52
    assert given(known)[:2] == [[TRIALS[50]], [TRIALS[51]]]


def test_a_batch_holds_trials_of_one_configuration() -> None:
    kinds = [specification(0), specification(0, horizon=7)]
    mixed = [kind.with_seed(seed) for seed in range(5) for kind in kinds]
    taken = given(Chunks(mixed, seconds=1.0, slots=1, batch=3))
    assert [len(batch) for batch in taken] == [3, 2, 3, 2]
    assert all(len({trial.config_key for trial in batch}) == 1 for batch in taken)
    assert {t.trial_key for batch in taken for t in batch} == {t.trial_key for t in mixed}


RECORD = LaunchRecord(argv=["work"], overrides=[], host="here", pid=1)

Build = Callable[..., tuple[StoredChunks, list[str]]]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(f"sqlite:///{tmp_path / 'results.db'}") as opened:
        yield opened


@pytest.fixture
def build(store: Store) -> Build:
    """Return a function that registers trials and looks at them as a worker does."""

    def look(
        trials: list[TrialSpec],
        measured: dict[str, float],
        length: float | None = None,
        slots: int = 2,
    ) -> tuple[StoredChunks, list[str]]:
        launch = store.begin_launch(RECORD)
        store.register(launch, trials)
        for policy, seconds in measured.items():
            spec = short_trial(policy, seed=1000)
            (claim,) = store.claim(launch, store.register(launch, [spec]).todo)
            run = RunRecord(**{**vars(RUN), "wall_seconds": seconds})
            store.commit(claim, outcome(spec), run)
        said: list[str] = []
        patient = RetryingStore(store, launch, Patience(1.0, said.append))
        chunks = StoredChunks(patient, 1.0, slots, length, said.append)
        chunks.look()
        return chunks, said

    return look


def trials_of(policy: str, n: int) -> list[TrialSpec]:
    return [short_trial(policy, seed) for seed in range(n)]


def policies(chunks: StoredChunks, times: int) -> list[str]:
    return [chunks.next()[0].spec.policy.name for _ in range(times)]


def test_unknown_trials_come_first_one_at_a_time_then_the_longest(build: Build) -> None:
    trials = trials_of("random", 4) + trials_of("uniform", 1) + trials_of("periodic", 1)
    chunks, _ = build(trials, {"random": 0.6, "periodic": 30.0})
    assert policies(chunks, 3) == ["uniform", "periodic", "random"]


def test_a_chunk_holds_the_wanted_seconds_and_pending_trials_only(build: Build) -> None:
    trials = trials_of("random", 100)
    chunks, _ = build(trials, {"random": 0.1})
    chunk = chunks.next()
    assert len(chunk) == 10
    assert {task.key for task in chunk} <= {trial.trial_key for trial in trials}


def test_nothing_starts_that_may_end_too_late(build: Build) -> None:
    trials = trials_of("random", 50) + trials_of("periodic", 50)
    chunks, _ = build(trials, {"random": 1.0, "periodic": 20.0}, length=25.0)
    assert policies(chunks, 1) == ["random"]  # 1.5 times 20 s is too long
    chunks.pending = 2  # the next one waits for the first to end
    assert len(chunks) > 0
    late, _ = build(trials, {}, length=1.2)
    assert len(late) == 0
    assert late.waiting == 100


@pytest.mark.parametrize(
    ("measured", "length", "size"),
    [({}, 100.0, 1), ({"random": 3.0}, 8.0, 1)],
    ids=["the first of its kind may take half of the time", "what runs counts for what waits"],
)
def test_a_process_that_is_busy_leaves_no_time(
    build: Build, measured: dict[str, float], length: float, size: int
) -> None:
    chunks, _ = build(trials_of("random", 50), measured, length=length)
    assert len(chunks.next()) == size
    assert len(chunks) > 0
    chunks.pending = 2
    assert len(chunks) == 0


def test_a_trial_that_killed_a_process_goes_alone(store: Store, build: Build) -> None:
    trials = trials_of("random", 10)
    launch = store.begin_launch(RECORD)
    keys = store.register(launch, trials).todo
    store.claim(launch, keys[3:4])
    store.release(launch, keys[3:4], "killed")
    chunks, _ = build(trials, {"random": 1e-3}, slots=1)
    found = []
    while len(chunks):
        chunk = chunks.next()
        store.claim(launch, [task.key for task in chunk])
        found.append([task.spec.seed for task in chunk])
    assert [3] in found
    assert sorted(itertools.chain.from_iterable(found)) == list(range(10))


def stored(**changes: object) -> OpenConfig:
    spec = short_trial("random", 0)
    content = {**json.loads(spec.config_json), **changes}
    return OpenConfig(1, spec.config_key, json.dumps(content), 3, 0, None, None)


ELSEWHERE = {"_target_": "systems_of_mine.Rocket", "source": "0" * 16}
NEVER_RUN = {"_target_": "never_run.Rocket"}
OTHER_VERSION = {"code_version": 10**6, "env": {"name": "pendulum", "horizon": 6}}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"env": ELSEWHERE}, r"systems_of_mine\.Rocket.*PYTHONPATH"),
        ({"env": NEVER_RUN}, r"never_run\.Rocket"),
        ({"env": {**NEVER_RUN, "source": "0" * 16}}, r"never_run\.Rocket"),
        (OTHER_VERSION, "another version of the code"),
    ],
)
def test_a_trial_that_cannot_be_the_stored_one_is_refused(
    changes: dict[str, Any], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "never_run.py").write_text("raise SystemExit('it has run')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(DoptError, match=sentence):
        trial_of(stored(**changes), 1)


def grid(seeds: int, width: int, form: str = "primal") -> Grid:
    """Return trials of the pendulum; width 100 has q = 10,601 parameters and needs 1.69 GiB."""
    settings: dict[str, Any] = {
        "env": {"name": "pendulum"},
        "policy": {"name": "d_optimal", "form": form},
        "model": {"name": "mlp", "width": width},
        "learner": {"name": "adam"},
        "seed": 0,
    }
    return build_grid([Combination(settings, range(seeds))])


def launch(executor: str = "local", **settings: Any) -> LaunchSettings:
    return LaunchSettings(executor, "sqlite:///results.db", **settings)


@pytest.mark.parametrize(
    ("seeds", "width", "settings", "gib"),
    [
        (100, 16, launch(workers=64), 2),
        (100, 100, launch(workers=2), 4),
        (2, 100, launch(workers=64), 4),
        (100, 100, launch("inprocess"), 2),
        # Of another machine nothing is known.
        (9, 100, launch("ray", ray_address="ray://head:10001"), 1),
        (9, 100, launch("lockstep", executor_options={"device": "cuda"}), 1),
    ],
)
def test_what_fits_is_accepted(seeds: int, width: int, settings: LaunchSettings, gib: int) -> None:
    check_memory(grid(seeds, width), settings, machine=gib * BYTES_PER_GIB)


@pytest.mark.parametrize(
    ("seeds", "settings", "gib", "sentence"),
    [
        (1, launch(), 1, r"policy=d_optimal needs 1\.6\d GiB .* has 1 GiB: make "),
        (100, launch(workers=8), 8, "8 trials at the same time need 13.* set launch.workers=4"),
        (100, launch("ray", workers=8), 8, "set launch.workers=4"),
        (100, launch("lockstep", executor_options={"batch": 20}), 8, "20 .* executor.batch=4"),
        (
            1,
            launch("ray", ray_address="ray://h:1", memory_gib=0.5),
            None,
            r"launch\.memory_gib allows 0\.5 GiB: raise it",
        ),
    ],
)
def test_what_does_not_fit_is_refused_with_what_decides(
    seeds: int, settings: LaunchSettings, gib: int | None, sentence: str
) -> None:
    with pytest.raises(LaunchError, match=sentence):
        check_memory(grid(seeds, 100), settings, machine=gib and gib * BYTES_PER_GIB)


def test_only_the_cores_that_we_may_use_count(monkeypatch: pytest.MonkeyPatch) -> None:
    assert 2**28 < memory_of_this_machine() < 2**50
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {3})
    check_memory(grid(100, 100), launch(), machine=2 * BYTES_PER_GIB)
