"""Ratios of a measure to that of random inputs, and intervals as columns of a table."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from analysis.formatting import within
from analysis.tables.comparisons import against_reference
from analysis.yardsticks.growth import Interval

REFERENCE = "random"


def interval_columns(name: str, interval: Interval) -> dict[str, float]:
    """Return a value and the ends of its interval by the names of their columns."""
    return dict(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))


def ratio_to_random(trials: pd.DataFrame, policy: str, measure: str, question: str) -> Interval:
    """Return the geometric mean of a measure by that of random inputs of the same seed.

    ``trials`` has the columns ``policy``, ``seed`` and the measure; ``question`` names what they
    have in common. It is NaN for random inputs themselves, and where there are none.
    """
    own, reference = (
        dict(zip(part.seed, part[measure], strict=True))
        for part in (trials[trials.policy == one] for one in (policy, REFERENCE))
    )
    if policy == REFERENCE or not reference:
        return np.nan, np.nan, np.nan
    found = against_reference(own, reference, question, policy, measure)
    return found.ratio, found.low, found.high


def ratio_text(row: Mapping[Hashable, Any]) -> str:
    """Return the ratio of a row with its interval."""
    return within(row["ratio"], row["ratio_low"], row["ratio_high"])
