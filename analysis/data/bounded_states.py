"""States of a trial that its limits bound, and how often they were beyond them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.data.trial_selection import Entry
from dopt.limits import VIOLATIONS, limits_from
from dopt.systems import System
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]


def bounded_states(config: Mapping[str, Any], system: System) -> dict[int, Array]:
    """Return the lower and the upper bound (2,) of each state that has one, by its place.

    Bounds are in the unit of the state, infinite where there is none.
    """
    limits = limits_from(config.get("limits"))
    if limits is None:
        return {}
    bounds = limits.of_states(system)
    return {int(i): bounds[i] for i in np.flatnonzero(np.isfinite(bounds).any(axis=1))}


def violation_shares(reader: Reader, entry: Entry) -> dict[int, float]:
    """Return the share of steps after which a bound is exceeded, by the seed of a finished trial.

    Steps before a trial diverged count. Trials without limits have none.
    """
    found = reader.assessments(entry.config.config_key, VIOLATIONS)
    values = found.values / np.maximum(found.t, 1)
    counted = {
        int(seed): row[np.isfinite(row)] for seed, row in zip(found.seeds, values, strict=True)
    }
    finished = [trial.seed for trial in entry.finished]
    return {seed: float(counted[seed].sum()) for seed in finished if len(counted.get(seed, ())) > 0}
