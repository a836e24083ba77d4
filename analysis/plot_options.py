"""Choices that change what is shown, beside the selection of trials, and how many at a time."""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass
from enum import StrEnum

from analysis.data.samples import DivergenceRule
from analysis.stats.intervals import BandKind, Statistic
from dopt.process import usable_cores
from orchestrate.program import UsageError


class Axis(StrEnum):
    """What the horizontal axis counts."""

    STEPS = "steps"
    SECONDS = "seconds"


class Spread(StrEnum):
    """Drawing of the interval of a loss curve: a band over all steps, or bars at a few."""

    BAND = "band"
    ERRORBAR = "errorbar"


@dataclass(frozen=True)
class PlotOptions:
    """Options of the plots; ``epsilon`` is the loss of the comparison of steps, None the default's.

    ``axis``, ``statistic``, ``spread`` and ``color_by``, the setting whose values have a colour
    each, and ``band``, what the intervals are of, belong to the loss curves.
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


def add_workers(command: argparse.ArgumentParser, what: str) -> None:
    """Add the option; ``what`` names the things."""
    cores = usable_cores()
    command.add_argument(
        "--workers", type=_workers, default=cores, help=f"{what} at a time (one for each core)"
    )


def _workers(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise UsageError(f"--workers is {text}, but at least 1 is expected: give a whole number.")
    return int(text)
