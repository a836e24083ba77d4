"""States of a trial that its limits bound."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from dopt.limits import limits_from
from dopt.systems import System

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
