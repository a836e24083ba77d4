"""Choices that change what is shown, beside the selection of trials."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum

from analysis.data.divergence import DivergenceRule
from analysis.figures.loss_curves.data import Axis
from analysis.stats.intervals import Statistic
from analysis.stats.tolerance import BandKind


class Spread(StrEnum):
    """Drawing of the interval of a loss curve: a band over all steps, or bars at a few."""

    BAND = "band"
    ERRORBAR = "errorbar"


@dataclass(frozen=True)
class PlotOptions:
    """Options of the plots; ``epsilon`` is the loss of the comparison of steps, None the default's.

    ``axis``, ``statistic``, ``spread`` and ``color_by``, the setting whose values have a colour
    each, and ``band``, what the intervals are of, are those of the loss curves.
    """

    rule: DivergenceRule = DivergenceRule.EXCLUDE
    axis: Axis = Axis.STEPS
    statistic: Statistic = Statistic.MEAN
    spread: Spread = Spread.BAND
    epsilon: float | None = None
    color_by: str | None = None
    band: BandKind = BandKind.CONFIDENCE

    @property
    def interval(self) -> str:
        """Return the name of the intervals of the loss curves."""
        return self.band.label(self.statistic)

    def as_dict(self) -> dict[str, str]:
        return {key: str(value) for key, value in asdict(self).items()}
