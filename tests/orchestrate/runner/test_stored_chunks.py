"""Chunks of pending trials: the longest first, in time, and only what this machine can run."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dopt.errors import DoptError
from dopt.spec.trial import TrialSpec
from orchestrate.records import RunRecord
from orchestrate.runner.saving import RetryingStore
from orchestrate.runner.worker import StoredChunks, trial_of
from orchestrate.store import LaunchRecord, OpenConfig, Store
from tests.orchestrate.faults.trials import outcome
from tests.orchestrate.standins import trial_of as short_trial
from tests.orchestrate.store.fakes import RUN

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
        patient = RetryingStore(store, launch, 1.0, said.append)
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


def test_the_first_trial_of_its_kind_may_take_half_of_the_time(build: Build) -> None:
    chunks, _ = build(trials_of("random", 5), {}, length=100.0)
    assert len(chunks.next()) == 1
    chunks.pending = 2
    assert len(chunks) == 0


def test_what_runs_counts_for_what_waits_behind_it(build: Build) -> None:
    chunks, _ = build(trials_of("random", 50), {"random": 3.0}, length=8.0)
    chunks.next()
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


def test_what_this_machine_cannot_build_is_left_to_others(
    build: Build, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orchestrate.runner.worker.memory_of_this_machine", lambda: 10)
    chunks, said = build(trials_of("random", 4), {})
    assert len(chunks) == 0
    assert (chunks.left, chunks.left_here, chunks.waiting) == (4, 0, 0)
    assert said == [one for one in said if "give a lower --processes" in one]
    chunks.look()
    assert len(said) == 1


def stored(**changes: object) -> OpenConfig:
    spec = short_trial("random", 0)
    content = {**json.loads(spec.config_json), **changes}
    return OpenConfig(1, spec.config_key, json.dumps(content), 3, 0, None, None)


def test_a_trial_is_built_from_what_is_stored() -> None:
    assert trial_of(stored(), 1).trial_key == short_trial("random", 0).trial_key


def test_a_class_that_is_not_here_is_named() -> None:
    env = {"_target_": "systems_of_mine.Rocket", "source": "0" * 16}
    with pytest.raises(DoptError, match=r"systems_of_mine\.Rocket.*PYTHONPATH"):
        trial_of(stored(env=env), 1)


@pytest.mark.parametrize("source", [{}, {"source": "0" * 16}])
def test_a_file_that_is_not_the_stored_one_does_not_run(
    source: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "never_run.py").write_text("raise SystemExit('it has run')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(DoptError, match=r"never_run\.Rocket"):
        trial_of(stored(env={"_target_": "never_run.Rocket", **source}), 1)


def test_a_configuration_of_another_version_is_refused() -> None:
    with pytest.raises(DoptError, match="another version of the code"):
        trial_of(stored(code_version=10**6, env={"name": "pendulum", "horizon": 6}), 1)
