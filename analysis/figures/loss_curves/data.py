"""Figure 1 as numbers: mean loss over trials with its interval, at every step."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.config_matching import check_keys, setting_value
from analysis.data.curves import read_sample
from analysis.data.divergence import DivergenceRule, Sample
from analysis.data.trial_selection import Entry, Selection
from analysis.line_styles import LineStyle, policy_style, sequence_style
from analysis.stats.intervals import Band, Statistic, band
from analysis.stats.tolerance import BandKind, tolerance_band
from analysis.units import loss_unit
from dopt.spec.prequential import is_prequential, system_of
from orchestrate.store import Reader


class Axis(StrEnum):
    """What the horizontal axis counts."""

    STEPS = "steps"
    SECONDS = "seconds"


@dataclass(frozen=True)
class LossCurve:
    """One entry in one environment: t in steps (T,), x on the axis (T,), band over trials.

    ``unit`` is that of the loss, which is that of an exploration where ``is_prequential``.
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
    reader: Reader,
    selection: Selection,
    column: str,
    rule: DivergenceRule,
    axis: Axis = Axis.STEPS,
    statistic: Statistic = Statistic.MEAN,
    color_by: str | None = None,
    band_kind: BandKind = BandKind.CONFIDENCE,
) -> tuple[LossCurve, ...]:
    """Return a curve for each entry of the selection, in its order.

    ``color_by`` is the setting whose values have a colour each, by default the first of those by
    which the selection is grouped.
    """
    styles = line_styles(selection, color_by)
    return tuple(
        _measure(reader, entry, styles[entry.label], column, rule, axis, statistic, band_kind)
        for entry in selection.entries
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
        if key == "policy" and selection.group_by == ("policy",):
            styles[entry.label] = replace(policy_style(entry.config.policy), label=entry.label)
            continue
        value = repr(setting_value(entry.config, key))
        base = policy_style(entry.config.policy).colour if key == "policy" else None
        styles[entry.label] = sequence_style(values.index(value), used[value], entry.label, base)
        used[value] += 1
    return styles


def _measure(
    reader: Reader,
    entry: Entry,
    style: LineStyle,
    column: str,
    rule: DivergenceRule,
    axis: Axis,
    statistic: Statistic,
    band_kind: BandKind,
) -> LossCurve:
    sample = read_sample(reader, entry, column, rule)
    t = np.arange(sample.values.shape[1])
    system = system_of(entry.config.config)
    scale = system.dt if axis is Axis.SECONDS else 1.0
    names = entry.config.env, entry.config.policy, entry.label
    x = scale * t.astype(float)
    limits = tolerance_band if band_kind is BandKind.TOLERANCE else band
    shown = limits(sample.values, statistic)
    unit, prequential = loss_unit(system), is_prequential(entry.config.config)
    return LossCurve(*names, style, t, x, unit, shown, statistic, sample, prequential)


def tabulate_curves(curves: tuple[LossCurve, ...]) -> pd.DataFrame:
    """Return what is drawn, one row for each environment, policy and step."""
    return pd.concat([_rows(curve) for curve in curves], ignore_index=True)


def _rows(curve: LossCurve) -> pd.DataFrame:
    return pd.DataFrame(
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
    )
