"""Centres and intervals of trials; loss curves, phase-plane lines and input spectra as numbers.

Everything is on the exact time grid; there is no smoothing and no sampling of runs. Three
statistics over the trials of a configuration, each with the interval that suits it: the mean
with Student's interval, and the median and the interquartile mean (IQM: the mean of the middle
half; Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021)
with a percentile bootstrap that draws whole trials.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from analysis.data.matching import setting_value
from analysis.data.samples import read_sample
from analysis.data.selection import Entry, Selection
from analysis.style import LineStyle, loss_unit, policy_style, sequence_style
from dopt.assessment import TURN, Plane, turns, wrap
from dopt.spec.trial import is_prequential, system_of
from dopt.types import Array, Integers
from orchestrate.store import Reader

CONFIDENCE = 0.95
"""Confidence level of every interval."""

BAND_RESAMPLES = 1999
"""Draws of a bootstrap band: the 2.5 % quantile is then the 50th smallest."""

MEAN_RESAMPLES = 9999
"""Draws of a bootstrap of one mean, and of means over systems."""

FEWEST_BOOTSTRAP_VALUES = 30
"""Values below which a bootstrap is too narrow (95 % meant, of normal differences: 82 % for 5,
93.8 % for 20; of exponential ones 89 % for 20); Student's is nearer (91 % of exponential ones)."""

MOST_BOOTSTRAP_VALUES = 2000
"""Values above which the mean has Student's interval: the time of the bootstrap grows with their
square. The ends differ by less than 5 % of a half-width there, of normal and of exponential values,
where the draws of the bootstrap alone make 3 %."""

FEWEST_BAND_VALUES = 6
"""Values from which a median or interquartile mean has a band: of fewer, even their range covers
the median of the distribution in less than 95 % (1 - 2^(1-n))."""

_ROUNDING = 1e-14
"""Spread of values that differ by rounding alone, relative to the largest."""

STUDENT_RANGE = f"Student's below {FEWEST_BOOTSTRAP_VALUES} and above {MOST_BOOTSTRAP_VALUES}"
"""Numbers of values whose interval is Student's, for the notes of tables and figures."""


class Statistic(StrEnum):
    """Statistic of the trials that a curve shows at each step."""

    MEAN = "mean"
    MEDIAN = "median"
    IQM = "iqm"

    @property
    def label(self) -> str:
        """Return the name in a caption."""
        return "interquartile mean" if self is Statistic.IQM else str(self)

    @property
    def band(self) -> str:
        """Return the name of the interval, printed wherever it is drawn."""
        if self is Statistic.MEAN:
            return "95 % t-interval of the mean"
        return f"95 % bootstrap interval of the {self.label}, from {FEWEST_BAND_VALUES} trials on"


@dataclass(frozen=True)
class Band:
    """A centre over n trials with its interval; each of shape (T,).

    Without an interval, as of one trial, low and high are NaN. With no trial, all is NaN.
    """

    centre: Array
    low: Array
    high: Array
    n: int


def standard_error(values: Array) -> Array:
    """Return s/√n along the first axis of (n, ...), NaN for fewer than two."""
    n = len(values)
    if n < 2:
        return np.full(values.shape[1:], np.nan)
    error: Array = np.std(values, axis=0, ddof=1) / np.sqrt(n)
    return error


def mean_columns(name: str, values: Array) -> dict[str, float]:
    """Return the mean of (n,) and two standard errors, as columns ``name`` and ``name_2se``."""
    return {name: float(centre(values)), f"{name}_2se": 2 * float(standard_error(values))}


def centre(values: Array, statistic: Statistic = Statistic.MEAN) -> Array:
    """Return a statistic along the first axis of (n, ...), NaN for none."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    found: Array = np.asarray(_CENTRES[statistic](values, axis=0))
    return found


def band(values: Array, statistic: Statistic = Statistic.MEAN) -> Band:
    """Return the centre of trials (n, T) at each step, with its 95 % interval.

    Mean: ± t·SE, t the two-sided Student quantile of n - 1. Median and IQM: percentile bootstrap,
    from :data:`FEWEST_BAND_VALUES` trials on. The draws have their own random stream, so that the
    band of the same trials is the same.
    """
    middle, n = centre(values, statistic), len(values)
    if n < (2 if statistic is Statistic.MEAN else FEWEST_BAND_VALUES):
        return _without_interval(middle, n)
    if statistic is Statistic.MEAN:
        half = student_quantile(n - 1) * standard_error(values)
        return Band(middle, middle - half, middle + half, n)
    return Band(middle, *_bootstrap(values, statistic), n)


def _without_interval(middle: Array, n: int) -> Band:
    unknown = np.full_like(middle, np.nan)
    return Band(middle, unknown, unknown, n)


def interval_of_mean(values: Array, rng: np.random.Generator) -> tuple[float, float]:
    """Return the interval of the mean of (n,): a BCa bootstrap, Student's for few and many."""
    if len(values) < 2:
        return float("nan"), float("nan")
    if np.ptp(values) <= _ROUNDING * np.abs(values).max():
        return float(values[0]), float(values[0])
    if not FEWEST_BOOTSTRAP_VALUES <= len(values) <= MOST_BOOTSTRAP_VALUES:
        half = float(student_quantile(len(values) - 1) * standard_error(values))
        return float(np.mean(values)) - half, float(np.mean(values)) + half
    from scipy import stats

    found = stats.bootstrap(
        (values,), np.mean, n_resamples=MEAN_RESAMPLES, confidence_level=CONFIDENCE, rng=rng
    ).confidence_interval
    return float(found.low), float(found.high)


def student_quantile(freedom: float | Array) -> Array:
    """Return how many standard errors Student's two-sided interval reaches to each side."""
    from scipy.special import stdtrit  # what scipy.stats calls, whose import takes longer

    return np.asarray(stdtrit(freedom, 0.5 + CONFIDENCE / 2))


def _bootstrap(values: Array, statistic: Statistic) -> tuple[Array, Array]:
    """Return the percentile interval of trials (n, T), each end (T,).

    A draw takes the same trials at every step. Median and IQM are means of the middle of a sorted
    sample. Ranks of 32 bits are sorted, in two thirds of the time that the values would take.
    """
    n = len(values)
    first, last = n // 4, n - n // 4
    if statistic is Statistic.MEDIAN:
        first, last = (n - 1) // 2, n // 2 + 1
    drawn = np.random.default_rng(0).integers(0, n, (BAND_RESAMPLES, n))
    ranks = values.argsort(axis=0).argsort(axis=0).astype(np.int32)
    steps = zip(np.sort(values, axis=0).T, ranks.T, strict=True)
    middles = [step[np.sort(rank[drawn], axis=1)[:, first:last]] for step, rank in steps]
    return _ends(np.stack([middle.mean(axis=1) for middle in middles], axis=-1))


def _ends(drawn: Array) -> tuple[Array, Array]:
    """Return the percentile interval of draws (k, ...)."""
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(drawn, [tail, 100 - tail], axis=0)
    return low, high


def _interquartile_mean(values: Array, axis: int) -> Array:
    from scipy import stats

    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


_CENTRES: dict[Statistic, Any] = {
    Statistic.MEAN: np.mean,
    Statistic.MEDIAN: np.median,
    Statistic.IQM: _interquartile_mean,
}


def stratified_mean(strata: Sequence[Array]) -> Band:
    """Return the mean over S systems of the means over their runs (n_s, k), each n_s at least 1.

    The interval of 95 % is a percentile bootstrap, pointwise in k, whose draws have their own
    random stream: equal numbers of runs give equal draws. Where a system has fewer than 30 runs it
    is Student's, with the degrees of freedom of Welch and Satterthwaite: of 4 systems with 5 runs
    the bootstrap covered 88 % of normal means. NaN where a system has one run.
    """
    middle = np.mean([np.mean(values, axis=0) for values in strata], axis=0)
    sizes = np.array([*map(len, strata)])
    n = int(sizes.sum())
    if sizes.min() < 2:
        return _without_interval(middle, n)
    if sizes.min() < FEWEST_BOOTSTRAP_VALUES:
        parts = np.array([standard_error(values) / len(strata) for values in strata]) ** 2
        variance, tiny = parts.sum(axis=0), np.finfo(float).tiny
        freedom = variance**2 / np.maximum((parts.T**2 / (sizes - 1)).T.sum(axis=0), tiny)
        half = student_quantile(np.maximum(freedom, 1.0)) * np.sqrt(variance)
        return Band(middle, middle - half, middle + half, n)
    drawn = np.zeros((MEAN_RESAMPLES, *middle.shape))
    for place, values in enumerate(strata):
        drawn += _weights(len(values), place) @ values / len(strata)
    return Band(middle, *_ends(drawn), n)


@functools.lru_cache(maxsize=8)
def _weights(n: int, place: int) -> Array:
    """Return the share that each of n runs of a system has in each draw, (MEAN_RESAMPLES, n)."""
    rng = np.random.default_rng(place)
    return np.asarray(rng.multinomial(n, np.full(n, 1 / n), size=MEAN_RESAMPLES) / n)


class Estimate(NamedTuple):
    """A geometric mean over trials with its 95 % interval, NaN for fewer than two."""

    value: float
    low: float
    high: float


def geometric_mean(values: Array) -> Estimate:
    """Return the geometric mean of (n,); NaN for none and where a value has no logarithm.

    The interval belongs to the mean logarithm: a BCa bootstrap, Student's for few trials.
    """
    if not len(values) or not np.all((values > 0) & np.isfinite(values)):
        return Estimate(*[float("nan")] * 3)
    logs = np.log(values)
    low, high = interval_of_mean(logs, np.random.default_rng(0))
    return Estimate(*(float(np.exp(end)) for end in (np.mean(logs), low, high)))


class Axis(StrEnum):
    """Quantity of the horizontal axis."""

    STEPS = "steps"
    SECONDS = "seconds"


class Spread(StrEnum):
    """Drawing of the interval of a loss curve: a band over all steps, or bars at a few."""

    BAND = "band"
    ERRORBAR = "errorbar"


@dataclass(frozen=True)
class PlotOptions:
    """Options of the plots; ``epsilon`` is the loss of the comparison of steps, None the default's.

    ``axis``, ``statistic`` and ``spread`` belong to the loss curves.
    """

    axis: Axis = Axis.STEPS
    statistic: Statistic = Statistic.MEAN
    spread: Spread = Spread.BAND
    epsilon: float | None = None


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


def log_limits(values: Array, margin: float = 1.15) -> tuple[float, float]:
    """Return limits around the positive, finite ones of some values; (0.1, 1) for none."""
    usable = values[np.isfinite(values) & (values > 0)]
    if not len(usable):
        return 0.1, 1.0
    return float(usable.min()) / margin, float(usable.max()) * margin


@dataclass(frozen=True)
class LossCurve:
    """One entry in one environment: t in steps (T,), x on the axis (T,), band over trials.

    ``unit`` is the loss's, ``count`` the number of trials as a text; where ``is_prequential``, the
    curve belongs to an exploration.
    """

    env: str
    policy: str
    label: str
    style: LineStyle
    t: Integers
    x: Array
    unit: str
    band: Band
    statistic: Statistic
    count: str
    n_diverged: int
    is_prequential: bool = False


def measure_curves(
    reader: Reader, selection: Selection, column: str, options: PlotOptions
) -> tuple[LossCurve, ...]:
    """Return a curve for each entry of the selection, in its order."""
    styles = line_styles(selection)
    return tuple(
        _curve(reader, entry, styles[entry.label], column, options) for entry in selection.entries
    )


def line_styles(selection: Selection) -> dict[str, LineStyle]:
    """Return the style of each label: of policies their own, of other settings by value.

    The first setting of ``group_by`` decides about colours; entries of one colour are told apart
    by their dashes.
    """
    key = selection.group_by[0]
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
    config, sample = entry.config, read_sample(reader, entry, column)
    t = np.arange(sample.values.shape[1])
    system = system_of(config.config)
    return LossCurve(
        *(config.env, config.policy, entry.label, style, t),
        x=(system.dt if options.axis is Axis.SECONDS else 1.0) * t.astype(float),
        unit=loss_unit(system),
        band=band(sample.values, options.statistic),
        statistic=options.statistic,
        count=entry.describe(len(sample.values)),
        n_diverged=entry.n_diverged,
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
            "n_diverged": curve.n_diverged,
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
    count, inside = turns(line[:, axis], centre), line.copy()
    inside[:, axis] = wrap(line[:, axis], centre)
    jumps = np.diff(count)
    places = np.flatnonzero(jumps)
    pieces = np.split(inside, places + 1)
    for i, place in enumerate(places):
        edges = _crossing(line[place], line[place + 1], axis, centre, jumps[place])
        pieces[i] = np.concatenate([pieces[i], edges])
    return np.concatenate(pieces)


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


def average_spectrum(inputs: Array, dt: float) -> dict[str, Array]:
    """Return columns of the periodograms of inputs (n, T, m): mean and quantiles over trials."""
    frequency, density = periodogram(inputs, dt)
    low, high = np.quantile(density, QUANTILES, axis=0)
    columns = {"mean": np.mean(density, axis=0), "quantile_10": low, "quantile_90": high}
    return {"frequency_hz": frequency, **columns}


def median_seed(losses: dict[int, float]) -> int:
    """Return the seed with the median loss, the lower one of two; ties go to the lower seed."""
    ranked = sorted(losses, key=lambda seed: (losses[seed], seed))
    return ranked[(len(ranked) - 1) // 2]
