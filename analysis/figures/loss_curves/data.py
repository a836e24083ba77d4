"""Figure 1 as numbers: mean loss over trials with its interval, at every step."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.divergence import DivergenceRule, Sample
from analysis.reading import read_sample
from analysis.selection import Entry, Selection
from analysis.statistics import Band, Statistic, band
from dopt.systems import system_from_mapping
from orchestrate.store import Reader


class Axis(StrEnum):
    """What the horizontal axis counts."""

    STEPS = "steps"
    SECONDS = "seconds"


@dataclass(frozen=True)
class LossCurve:
    """One policy in one environment: t in steps (T,), x on the axis (T,), band over trials."""

    env: str
    policy: str
    t: npt.NDArray[np.int64]
    x: npt.NDArray[np.float64]
    band: Band
    statistic: Statistic
    sample: Sample


def measure_curves(
    reader: Reader,
    selection: Selection,
    column: str,
    rule: DivergenceRule,
    axis: Axis = Axis.STEPS,
    statistic: Statistic = Statistic.MEAN,
) -> tuple[LossCurve, ...]:
    """Return a curve for each entry of the selection, in its order."""
    return tuple(
        _measure(reader, entry, column, rule, axis, statistic) for entry in selection.entries
    )


def _measure(
    reader: Reader,
    entry: Entry,
    column: str,
    rule: DivergenceRule,
    axis: Axis,
    statistic: Statistic,
) -> LossCurve:
    sample = read_sample(reader, entry, column, rule)
    t = np.arange(sample.values.shape[1])
    scale = system_from_mapping(entry.cell.config["env"]).dt if axis is Axis.SECONDS else 1.0
    x, cell = scale * t.astype(float), entry.cell
    shown = band(sample.values, statistic)
    return LossCurve(cell.env, cell.policy, t, x, shown, statistic, sample)


def tabulate_curves(curves: tuple[LossCurve, ...]) -> pd.DataFrame:
    """Return what is drawn, one row for each environment, policy and step."""
    return pd.concat([_rows(curve) for curve in curves], ignore_index=True)


def _rows(curve: LossCurve) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "env": curve.env,
            "policy": curve.policy,
            "t": curve.t,
            "x": curve.x,
            str(curve.statistic): curve.band.centre,
            "low": curve.band.low,
            "high": curve.band.high,
            "n": curve.band.n,
            "n_diverged": curve.sample.n_diverged,
        }
    )
