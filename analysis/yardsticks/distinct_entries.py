"""Configurations of a published table with their trials: one for each of its places."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

from analysis.data.latest_configs import latest
from analysis.data.trial_selection import Entry
from analysis.errors import AnalysisError
from orchestrate.store import ConfigRow, Reader


def distinct_entries(
    reader: Reader,
    belongs: Callable[[ConfigRow], bool],
    place: Callable[[Entry], tuple[Any, ...]],
    named: Callable[[Entry], str],
    example: str,
) -> list[Entry]:
    """Return the newest configurations that belong to a table, in the order of their places.

    Parameters
    ----------
    reader : Reader
        Database.
    belongs : callable
        Whether a configuration belongs to the table.
    place : callable
        Place of an entry in the table, by which the entries are sorted.
    named : callable
        Words for the place of an entry, such as "with the policy 'random'".
    example : str
        Condition that may choose one of several, such as ``env.horizon=1000``.

    Raises
    ------
    AnalysisError
        If two configurations have the same place.
    """
    found = latest(reader, [one for one in reader.configs() if belongs(one)])
    entries = [Entry(one, tuple(reader.trials(one.config_key))) for one in found]
    entries.sort(key=place)
    for one, other in itertools.pairwise(entries):
        if place(one) == place(other):
            raise AnalysisError(
                f"There are two configurations {named(one)}, but one is expected: choose by "
                f"--where, such as --where {example}."
            )
    return entries
