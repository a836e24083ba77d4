"""An unknown name is answered with the nearest valid one."""

from __future__ import annotations

import pytest

from dopt.errors import unknown_name

NAMES = ("random", "d_optimal", "first/random_held", "first/prbs", "second/exact", "second/max")


@pytest.mark.parametrize(
    ("given", "nearest"),
    [
        ("d_optimla", "d_optimal"),
        ("second/exatc", "second/exact"),
        ("secnd/exact", "second/exact"),
        ("first/exact", "second/exact"),
        ("second/random", "random"),
        ("random_held", "first/random_held"),
        ("random_hold", "first/random_held"),
        ("prbs", "first/prbs"),
        ("mxa", "second/max"),
    ],
)
def test_the_nearest_name_counts_its_folder_or_not(given: str, nearest: str) -> None:
    message = str(unknown_name("policy", given, NAMES))
    start = f"policy '{given}' is unknown: did you mean '{nearest}'? Choose one of d_optimal, "
    assert message.startswith(start)


@pytest.mark.parametrize("given", ["", "wxyz", None, 7])
def test_no_name_is_suggested_where_none_is_near(given: object) -> None:
    assert str(unknown_name("policy", given, NAMES)).endswith(
        "is unknown: choose one of d_optimal, first/prbs, first/random_held, random, "
        "second/exact, second/max."
    )


def test_where_there_is_no_name_none_is_asked_for() -> None:
    assert str(unknown_name("field", "form", ())).endswith(
        "is unknown, no field exists: remove it."
    )
