"""Assessments come with their trials, whole and never changed."""

from __future__ import annotations

import pytest
from sqlalchemy import create_engine, text

from orchestrate.store import Store
from orchestrate.store.merge import merge
from tests.orchestrate.store.everything import everything
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, assessed


def assess(url: str, *several: Spec) -> None:
    """Run trials that are assessed."""
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        for claim, spec in zip(
            store.claim(launch, store.register(launch, several).todo), several, strict=True
        ):
            store.commit(claim, assessed(spec.seed), RUN)
        store.end_launch(launch, "done")


def test_assessments_come_with_their_trials(url: str, other: str) -> None:
    assess(other, Spec(0), Spec(1))
    assert merge(url, other).added == {"done": 2}
    assert everything(url) == everything(other)
    again = merge(url, other)
    assert (again.identical, again.conflicts) == (2, [])


@pytest.mark.parametrize("damage", ["DELETE FROM assessment WHERE t = 3", "DELETE FROM assessment"])
def test_a_trial_that_lost_assessments_does_not_come(url: str, other: str, damage: str) -> None:
    assess(other, Spec(0), Spec(1))
    engine = create_engine(other)
    with engine.begin() as connection:
        first = "(SELECT min(trial_id) FROM trial)"
        joint = "AND" if "WHERE" in damage else "WHERE"
        connection.execute(text(f"{damage} {joint} trial_id = {first}"))
    engine.dispose()
    found = merge(url, other)
    assert [one.trial_key for one in found.incomplete] == [Spec(0).trial_key]
    assert found.added == {"done": 1}


def test_another_assessment_is_a_conflict(url: str, other: str) -> None:
    for where in (url, other):
        assess(where, Spec(0))
    engine = create_engine(other)
    with engine.begin() as connection:
        connection.execute(text("UPDATE assessment SET value = 9 WHERE t = 3"))
    engine.dispose()
    assert [one.seed for one in merge(url, other).conflicts] == [0]
