"""Loss curves as numbers: mean loss over trials with its interval at each step; limits of axes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.matching import check_keys, setting_value
from analysis.data.samples import Sample, read_sample
from analysis.data.selection import Entry, Selection
from analysis.formatting import loss_unit
from analysis.line_styles import LineStyle, policy_style, sequence_style
from analysis.plot_options import Axis, PlotOptions
from analysis.stats.intervals import Band, BandKind, Statistic, band, tolerance_band
from dopt.spec.trial import is_prequential, system_of
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]
Limits = tuple[float, float]
GAP = 10.0
"""Ratio between the lowest means of two neighbouring curves from which the axis is broken."""

SETTLED = 0.1
"""Share of the steps after which a low curve is shown whole in the lower part."""


@dataclass(frozen=True)
class Parts:
    """Limits of the upper part of an axis, and of the lower one where it is broken."""

    upper: Limits
    lower: Limits | None = None


def axis_parts(bands: Sequence[Band]) -> Parts:
    """Return the limits that show some bands, broken at the widest gap if that is wide enough."""
    shown = [band for band in bands if np.any(band.centre > 0)]
    shown.sort(key=lambda band: _lowest(band))
    floors = np.array([_lowest(band) for band in shown])
    ratios = floors[1:] / floors[:-1]
    if not len(ratios) or ratios.max() < GAP:
        return Parts(band_limits(shown))
    first = int(np.argmax(ratios)) + 1
    low, high = band_limits(shown[first:])
    top = max(float(np.nanmax(band.centre)) for band in shown)
    bottom, _ = band_limits(shown[:first])
    settled = [band.centre[int(SETTLED * len(band.centre)) :] for band in shown[:first]]
    _, ceiling = log_limits(np.concatenate(settled), margin=1.5)
    return Parts((low, max(high, top)), (bottom, min(ceiling, low)))


def _lowest(band: Band) -> float:
    return float(np.min(band.centre[band.centre > 0]))


def band_limits(bands: Sequence[Band]) -> Limits:
    """Return limits that show every mean, and the bands down to a third of the lowest mean."""
    if not bands:
        return log_limits(np.empty(0))
    means = np.concatenate([band.centre for band in bands])
    low, _ = log_limits(means)
    edges = np.concatenate([edge for band in bands for edge in (band.low, band.high)])
    return log_limits(np.concatenate([means, edges[edges > low / 3]]))


def log_limits(values: npt.NDArray[np.float64], margin: float = 1.15) -> tuple[float, float]:
    """Return limits around the positive, finite ones of some values; (0.1, 1) for none."""
    usable = values[np.isfinite(values) & (values > 0)]
    if not len(usable):
        return 0.1, 1.0
    return float(usable.min()) / margin, float(usable.max()) * margin


@dataclass(frozen=True)
class LossCurve:
    """One entry in one environment: t in steps (T,), x on the axis (T,), band over trials.

    ``unit`` is the loss's; where ``is_prequential``, the curve belongs to an exploration.
    """

    env: str
    policy: str
    label: str
    style: LineStyle
    t: npt.NDArray[np.int64]
    x: npt.NDArray[np.float64]
    unit: str
    band: Band
    statistic: Statistic
    sample: Sample
    is_prequential: bool = False


def measure_curves(
    reader: Reader, selection: Selection, column: str, options: PlotOptions
) -> tuple[LossCurve, ...]:
    """Return a curve for each entry of the selection, in its order."""
    styles = line_styles(selection, options.color_by)
    return tuple(
        _curve(reader, entry, styles[entry.label], column, options) for entry in selection.entries
    )


def line_styles(selection: Selection, color_by: str | None = None) -> dict[str, LineStyle]:
    """Return the style of each label: of policies their own, of other settings by value.

    Entries of one colour are told apart by their dashes.
    """
    key = color_by or selection.group_by[0]
    check_keys([key], [entry.config for entry in selection.entries])
    values = list(dict.fromkeys(repr(setting_value(e.config, key)) for e in selection.entries))
    used: Counter[str] = Counter()
    styles: dict[str, LineStyle] = {}
    for entry in selection.entries:
        if entry.label in styles:
            continue
        own = policy_style(entry.config.policy)
        if key == "policy" and selection.group_by == ("policy",):
            styles[entry.label] = replace(own, label=entry.label)
            continue
        value = repr(setting_value(entry.config, key))
        base = own.colour if key == "policy" else None
        styles[entry.label] = sequence_style(values.index(value), used[value], entry.label, base)
        used[value] += 1
    return styles


def _curve(
    reader: Reader, entry: Entry, style: LineStyle, column: str, options: PlotOptions
) -> LossCurve:
    config, sample = entry.config, read_sample(reader, entry, column, options.rule)
    t = np.arange(sample.values.shape[1])
    system = system_of(config.config)
    limits = tolerance_band if options.band is BandKind.TOLERANCE else band
    return LossCurve(
        *(config.env, config.policy, entry.label, style, t),
        x=(system.dt if options.axis is Axis.SECONDS else 1.0) * t.astype(float),
        unit=loss_unit(system),
        band=limits(sample.values, options.statistic),
        statistic=options.statistic,
        sample=sample,
        is_prequential=is_prequential(config.config),
    )


def tabulate_curves(curves: Iterable[LossCurve]) -> pd.DataFrame:
    """Return what is drawn, one row for each environment, policy and step."""
    tables = [
        {
            "env": curve.env,
            "policy": curve.policy,
            "label": curve.label,
            "t": curve.t,
            "x": curve.x,
            str(curve.statistic): curve.band.centre,
            "low": curve.band.low,
            "high": curve.band.high,
            "n": curve.band.n,
            "n_diverged": curve.sample.n_diverged,
        }
        for curve in curves
    ]
    return pd.concat(map(pd.DataFrame, tables), ignore_index=True)
