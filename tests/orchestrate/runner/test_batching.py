"""Chunks hold about the wanted work, and every trial once."""

from __future__ import annotations

from dopt.spec.trial import TrialSpec
from orchestrate.runner.chunks import MAX_CHUNK_TRIALS, Chunks
from tests.orchestrate.standins import specification

TRIALS = [specification(seed) for seed in range(1000)]


def sizes(chunks: Chunks) -> list[int]:
    result = []
    while len(chunks):
        result.append(len(chunks.next()))
    return result


def chunks(trials: list[TrialSpec] = TRIALS, slots: int = 2) -> Chunks:
    return Chunks(trials, seconds=1.0, slots=slots)


def test_a_trial_of_unknown_cost_goes_alone() -> None:
    assert len(chunks().next()) == 1


def test_a_chunk_holds_the_wanted_seconds() -> None:
    known = chunks()
    known.observe(TRIALS[0].config_key, 0.1)
    assert len(known.next()) == 10


def test_a_trial_longer_than_a_chunk_goes_alone() -> None:
    known = chunks()
    known.observe(TRIALS[0].config_key, 30.0)
    assert len(known.next()) == 1


def test_cheap_trials_are_bounded_and_get_fewer_towards_the_end() -> None:
    known = chunks()
    known.observe(TRIALS[0].config_key, 1e-6)
    given = sizes(known)
    assert sum(given) == len(TRIALS)
    assert max(given) == MAX_CHUNK_TRIALS
    assert given == sorted(given, reverse=True)
    assert given[-1] == 1


def test_the_order_is_kept_and_nothing_is_given_twice() -> None:
    known = chunks(TRIALS[:50])
    known.observe(TRIALS[0].config_key, 0.2)
    seeds = []
    while len(known):
        seeds += [task.spec.seed for task in known.next()]
    assert seeds == [*range(50)]


def test_a_lost_trial_comes_first_and_alone() -> None:
    known = chunks(TRIALS[:50])
    known.observe(TRIALS[0].config_key, 1e-3)
    known.add(TRIALS[50:52], alone=True)
    assert len(known) == 52
    assert [[task.spec.seed for task in known.next()] for _ in range(2)] == [[50], [51]]


def test_a_batch_holds_trials_of_one_configuration() -> None:
    kinds = [specification(0), specification(0, horizon=7)]
    mixed = [kind.with_seed(seed) for seed in range(5) for kind in kinds]
    batches = Chunks(mixed, seconds=1.0, slots=1, batch=3)
    taken = []
    while len(batches):
        taken.append([task.spec for task in batches.next()])
    assert [len(batch) for batch in taken] == [3, 2, 3, 2]
    assert all(len({trial.config_key for trial in batch}) == 1 for batch in taken)
    assert {t.trial_key for batch in taken for t in batch} == {t.trial_key for t in mixed}
