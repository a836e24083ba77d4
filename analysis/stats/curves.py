"""Loss curves, phase-plane lines and input spectra as numbers; the options of figures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.matching import check_keys, setting_value
from analysis.data.samples import DivergenceRule, Sample, read_sample
from analysis.data.selection import Entry, Selection
from analysis.stats.intervals import Band, BandKind, Statistic, band, tolerance_band
from analysis.style import LineStyle, loss_unit, policy_style, sequence_style
from dopt.assessment import TURN, Plane, turns, wrap
from dopt.spec.trial import is_prequential, system_of
from orchestrate.store import Reader


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


QUANTILES = (0.1, 0.9)


def wrapped_line(line: Array, axis: int, centre: float = 0.0) -> Array:
    """Wrap one coordinate of a line, (n, 2) -> (n', 2), and break the line where it jumps.

    Where the angle leaves on one side and comes back on the other, the line is drawn up to the
    edge, a row of NaN breaks it, and it goes on from the opposite edge. A step of more than one
    turn is a break without edges: between the two samples nothing is known.
    """
    count = turns(line[:, axis], centre)
    pieces = [_wrapped(line[:1], axis, centre)]
    for before, after, jump in zip(line[:-1], line[1:], np.diff(count), strict=True):
        if jump:
            pieces.append(_crossing(before, after, axis, centre, jump))
        pieces.append(_wrapped(after[None], axis, centre))
    return np.concatenate(pieces)


def _wrapped(line: Array, axis: int, centre: float) -> Array:
    inside = line.copy()
    inside[:, axis] = wrap(line[:, axis], centre)
    return inside


def _crossing(before: Array, after: Array, axis: int, centre: float, jump: float) -> Array:
    """Return the rows edge, NaN, opposite edge between two samples (2,) on different turns."""
    gap = np.full((1, 2), np.nan)
    if abs(jump) != 1:
        return gap
    edge = centre + math.pi + TURN * float(turns(before[axis], centre) - (jump < 0))
    share = (edge - before[axis]) / (after[axis] - before[axis])
    leaving, entering = (before + share * (after - before) for _ in range(2))
    leaving[axis], entering[axis] = centre + jump * math.pi, centre - jump * math.pi
    return np.concatenate([leaving[None], gap, entering[None]])


class DrawnPlane(Plane):
    """A phase plane and the lines in it."""

    def line(self, points: Array) -> Array:
        """Return the line to draw through points (n, 2)."""
        for axis in range(2):
            if self.angles[axis]:
                points = wrapped_line(points, axis, self.centres[axis])
        return points


@dataclass(frozen=True)
class Spectrum:
    """Mean over trials and the 10 % and 90 % quantiles across them, each (F,)."""

    frequency: Array
    mean: Array
    low: Array
    high: Array
    n: int


def periodogram(inputs: Array, dt: float) -> tuple[Array, Array]:
    """Return f [Hz] and S [unit² / Hz] of inputs (n, T, m) sampled every dt seconds.

    Neither window nor detrending: the sum of S times the spacing of f is the mean square of u
    (Parseval).
    """
    from scipy import signal  # its import takes longer than most commands

    frequency, density = signal.periodogram(
        inputs, fs=1 / dt, window="boxcar", detrend=False, scaling="density", axis=1
    )
    return np.asarray(frequency, dtype=float), np.asarray(density, dtype=float).sum(axis=2)


def average_spectrum(inputs: Array, dt: float) -> Spectrum:
    """Return mean and quantiles over trials of the periodograms of inputs (n, T, m)."""
    frequency, density = periodogram(inputs, dt)
    low, high = np.quantile(density, QUANTILES, axis=0)
    return Spectrum(frequency, np.mean(density, axis=0), low, high, len(density))


def median_seed(losses: dict[int, float]) -> int:
    """Return the seed with the median loss, the lower one of two; ties go to the lower seed."""
    ranked = sorted(losses, key=lambda seed: (losses[seed], seed))
    return ranked[(len(ranked) - 1) // 2]
