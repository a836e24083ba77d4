"""Rule that stops a configuration when the geometric mean of its final loss is known."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from dopt.stopping.fixed_width import half_width, is_narrow
from orchestrate.runner.seed_rule import Losses, SeedRule, Seeds


class PreciseMeans(SeedRule):
    """Looks at each configuration by itself.

    Parameters
    ----------
    seeds
        Trials of each configuration.
    relative
        Largest half width of the interval, as a share of the geometric mean.
    """

    def __init__(self, seeds: Seeds, relative: float) -> None:
        self._seeds = seeds
        self._relative = relative
        self._values: dict[str, npt.NDArray[np.float64]] = {}
        self._precise: set[str] = set()

    def wanting(self, n: int) -> set[str]:
        more = {key for key, trials in self._seeds.items() if len(trials) > n}
        return more - self._precise

    def look(self, n: int, losses: Losses) -> None:
        for key in set(self._seeds) - self._precise:
            found = (losses.get(trial.trial_key) for trial in self._seeds[key][:n])
            self._values[key] = np.array([loss for loss in found if loss is not None])
            if is_narrow(self._values[key], self._relative):
                self._precise.add(key)

    def result(self, config_key: str) -> str:
        values = self._values.get(config_key, np.array([]))
        half = half_width(values)
        if math.isnan(half):
            return "mean unknown"
        mean = math.exp(float(np.mean(np.log(values))))
        found = f"mean {mean:.3g} ± {100 * math.expm1(half):.2g} %"
        return f"{found}, known" if config_key in self._precise else found

    def summary(self) -> str:
        return f"{len(self._precise):,} of {len(self._seeds):,} means known"
