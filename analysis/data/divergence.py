"""Rules for diverged trials: left out whole, or counted as the worst or the median."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


class DivergenceRule(StrEnum):
    """How diverged trials enter a statistic.

    ``EXCLUDE`` leaves them out, from the first step to the last; ``WORST`` and ``MEDIAN`` give them
    at each step the largest and the median loss of the trials that did not diverge.
    """

    EXCLUDE = "exclude"
    WORST = "worst"
    MEDIAN = "median"


@dataclass(frozen=True)
class Sample:
    """Curves that enter a statistic.

    Attributes
    ----------
    seeds : (n,)
    values : (n, T)
        Finite, after the rule was applied.
    n_finished : int
        Trials that ran to an end, diverged ones included.
    n_diverged : int
    """

    seeds: npt.NDArray[np.int64]
    values: Array
    n_finished: int
    n_diverged: int

    def describe(self) -> str:
        """Return the count to print, such as ``98/100, 2 diverged``."""
        used = len(self.values)
        if not self.n_diverged:
            return str(used)
        return f"{used}/{self.n_finished}, {self.n_diverged} diverged"


def apply_rule(
    seeds: npt.NDArray[np.int64], values: Array, diverged: Mask, rule: DivergenceRule
) -> Sample:
    """Return the sample (n, T) that a statistic sees, of trials (N, T) with NaN past divergence.

    Without a trial that survived, ``WORST`` and ``MEDIAN`` have nothing to lend and the sample is
    empty.
    """
    kept = values[~diverged]
    if rule is DivergenceRule.EXCLUDE or not len(kept) or not diverged.any():
        return Sample(seeds[~diverged], kept, len(values), int(diverged.sum()))
    lent = np.max(kept, axis=0) if rule is DivergenceRule.WORST else np.median(kept, axis=0)
    filled = np.where(diverged[:, None], lent, values)
    return Sample(seeds, filled, len(values), int(diverged.sum()))
