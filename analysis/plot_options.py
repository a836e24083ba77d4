"""Choices that change what is shown, beside the selection of trials."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum

from analysis.divergence import DivergenceRule
from analysis.loss_curves import Axis
from analysis.statistics import Statistic


class Spread(StrEnum):
    """How the interval of a loss curve is drawn: at every step, or as bars at a few."""

    BAND = "band"
    ERRORBAR = "errorbar"


@dataclass(frozen=True)
class Request:
    """What a user asks for; ``epsilon`` is the loss of the comparison of steps, None the default's.

    ``axis``, ``statistic`` and ``spread`` are those of the loss curves.
    """

    rule: DivergenceRule = DivergenceRule.EXCLUDE
    axis: Axis = Axis.STEPS
    statistic: Statistic = Statistic.MEAN
    spread: Spread = Spread.BAND
    epsilon: float | None = None

    def as_dict(self) -> dict[str, str]:
        return {key: str(value) for key, value in asdict(self).items()}
