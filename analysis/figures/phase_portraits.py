"""Figure 2: phase portraits, one panel per policy, same seed and axes; spectra of the inputs.

The spectral density is the one of D-optimal inputs, with the eigenfrequency (right).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from analysis.data.matching import REFERENCE, AnalysisError
from analysis.data.samples import coverages
from analysis.data.selection import Entry, Selection
from analysis.figures.panels import (
    COLUMN_WIDTH,
    GUIDE,
    TEXT_WIDTH,
    Plot,
    angle_ticks,
    legend_below,
    log_scale,
    mathematical,
    rows_and_columns,
    sheet,
)
from analysis.stats.curves import DrawnPlane, average_spectrum, centre, median_seed, standard_error
from analysis.style import (
    BLACK,
    but_diverged,
    count_text,
    environment_title,
    percent_text,
    policy_style,
    unit_of,
)
from dopt.assessment import CELLS
from dopt.spec.trial import system_of
from dopt.systems.properties import eigenmode
from dopt.types import Array
from orchestrate.store import Reader

SEED_RULE = "the seed whose D-optimal final loss is the median (the lower one of two)"
PANEL_HEIGHT = 2.1
MARGIN = 0.04

BOX: dict[str, Any] = {
    "facecolor": "#f3f3f3",
    "edgecolor": "#707070",
    "linestyle": (0, (3, 2)),
    "linewidth": 0.8,
}


@dataclass(frozen=True)
class Portrait:
    """The trajectory of one policy, and how much of the box its trials visit.

    Attributes
    ----------
    line : (n, 2)
        Drawn points: angles wrapped, rows of NaN where the line is broken. Empty when the policy
        has no finished trial of that seed.
    start : (2,)
    diverged : bool
    coverage, coverage_error : float
        Mean share of visited cells over the trials that did not diverge, and its standard error.
    n, n_diverged : int
        Trials in that mean, and trials left out of it.
    """

    policy: str
    line: Array
    start: Array
    diverged: bool
    coverage: float
    coverage_error: float
    n: int
    n_diverged: int


@dataclass(frozen=True)
class Portraits:
    """All portraits of one environment, of the same seed."""

    env: str
    seed: int
    plane: DrawnPlane
    panels: tuple[Portrait, ...]


def choose_seed(entries: Iterable[Entry]) -> int:
    """Return the seed to draw: the median of the reference policy's final losses."""
    for entry in entries:
        if entry.config.policy == REFERENCE and entry.final_losses():
            return median_seed(entry.final_losses())
    raise AnalysisError(
        f"A phase portrait shows {SEED_RULE}, but no finished trial of {REFERENCE} is stored: "
        f"run one, or leave this figure out."
    )


def measure_portraits(reader: Reader, selection: Selection, env: str) -> Portraits:
    """Return the portraits of one environment."""
    entries = selection.of(env)
    seed = choose_seed(entries)
    plane = DrawnPlane.of(system_of(entries[0].config.config))
    panels = tuple(_portrait(reader, entry, seed, plane) for entry in entries)
    return Portraits(env, seed, plane, panels)


def _portrait(reader: Reader, entry: Entry, seed: int, plane: DrawnPlane) -> Portrait:
    key, finished = entry.config.config_key, entry.finished
    status = {trial.seed: trial.status for trial in finished}
    points = np.empty((0, 2))
    if seed in status:
        points = plane.project(reader.trajectory(key, seed).states)
        points = points[np.isfinite(points).all(axis=1)]
    shares = np.array([*coverages(reader, entry, plane).values()])
    return Portrait(
        policy=entry.config.policy,
        line=plane.line(points) if len(points) else points,
        start=plane.wrapped(points[:1])[0] if len(points) else np.full(2, np.nan),
        diverged=status.get(seed) == "diverged",
        coverage=float(centre(shares)),
        coverage_error=float(standard_error(shares)),
        n=len(shares),
        n_diverged=len(finished) - len(shares),
    )


def tabulate_portraits(portraits: Portraits) -> pd.DataFrame:
    """Return what is drawn, one row for each point of a line; empty fields break the line."""
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "env": portraits.env,
                    "policy": panel.policy,
                    "seed": portraits.seed,
                    "x": panel.line[:, 0],
                    "y": panel.line[:, 1],
                    "coverage": panel.coverage,
                    "coverage_se": panel.coverage_error,
                    "n": panel.n,
                    "n_diverged": panel.n_diverged,
                }
            )
            for panel in portraits.panels
        ],
        ignore_index=True,
    )


def phase_plot(env: str) -> Plot[Portraits]:
    """Return the phase portraits of one environment."""
    return Plot(
        title=f"Phase portraits, {environment_title(env)}",
        statistic=f"one trajectory per policy: {SEED_RULE}; coverage: mean over trials",
        band="± 2 standard errors of the mean coverage (printed)",
        part=lambda selection, _: selection.only([env]).compared(),
        measure=lambda reader, selection, _: measure_portraits(reader, selection, env),
        tabulate=tabulate_portraits,
        draw=draw,
        caption=caption,
    )


def draw(portraits: Portraits) -> Figure:
    """Draw one panel for each policy, all with the same axes."""
    rows, columns = rows_and_columns(len(portraits.panels), 3)
    width = TEXT_WIDTH * max(columns, 2) / 3
    figure, grid = sheet(rows, columns, PANEL_HEIGHT, 0.6, width, sharex=True, sharey=True)
    panels = grid.ravel()
    for axes, portrait in zip(panels, portraits.panels, strict=False):
        _panel(axes, portrait, portraits.plane)
    last = len(portraits.panels)
    for axes in panels[last:]:
        axes.set_axis_off()
    _set_axes(panels[0], portraits)
    x_label, y_label = (mathematical(label) for label in portraits.plane.labels)
    for index, axes in enumerate(panels[:last]):
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label if index % columns == 0 else "")
    handles = _handles(portraits.seed)
    if last < len(panels):
        panels[-1].legend(handles=handles, loc="center")
    else:
        legend_below(figure, min(3, columns + 1), handles=handles)
    return figure


def _panel(axes: Axes, portrait: Portrait, plane: DrawnPlane) -> None:
    (left, right), (bottom, top) = plane.box
    axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, zorder=0.5, **BOX))
    style = policy_style(portrait.policy)
    axes.plot(portrait.line[:, 0], portrait.line[:, 1], color=style.colour, lw=0.7, zorder=2)
    axes.plot(*portrait.start, marker="o", ms=4, mfc="white", mec=BLACK, mew=1, zorder=3)
    n = but_diverged(portrait.n, portrait.n_diverged)
    covered = percent_text(portrait.coverage, portrait.coverage_error, portrait.n)
    axes.set_title(f"{style.label}\ncoverage {covered or 'unknown'} (n = {n})", fontsize=7.5)
    if not len(portrait.line):
        axes.text(0.5, 0.5, "no finished trial", transform=axes.transAxes, ha="center")
    elif portrait.diverged:
        axes.text(0.06, 0.07, "this trial diverged", transform=axes.transAxes, fontsize=6.5)


def _set_axes(axes: Axes, portraits: Portraits) -> None:
    # Not by the axis, whose view interval the panels that share it would not see.
    axes.set(xlim=_limits(portraits, 0), ylim=_limits(portraits, 1))
    for dimension, axis in enumerate((axes.xaxis, axes.yaxis)):
        if portraits.plane.angles[dimension]:
            angle_ticks(axis)


def _limits(portraits: Portraits, dimension: int) -> tuple[float, float]:
    values = np.concatenate([panel.line[:, dimension] for panel in portraits.panels])
    values = np.concatenate([values[np.isfinite(values)], portraits.plane.box[dimension]])
    low, high = float(values.min()), float(values.max())
    margin = MARGIN * (high - low)
    return low - margin, high + margin


def _handles(seed: int) -> list[Line2D | Patch]:
    return [
        Line2D([], [], color="#404040", lw=0.9, label=f"trajectory of seed {seed}"),
        Line2D([], [], ls="", marker="o", ms=4, mfc="white", mec=BLACK, mew=1, label="start"),
        Patch(**BOX, label="evaluation box"),
    ]


def caption(portraits: Portraits) -> str:
    """Return the caption, with the rule for the seed and what coverage is."""
    return (
        f"Phase portraits of the {environment_title(portraits.env)}, one panel per policy, "
        f"all of seed {portraits.seed} ({SEED_RULE}). Angles are wrapped around the stable "
        f"equilibrium and the line is broken where it wraps. Circle: start. Dashed: evaluation "
        f"box. Coverage: share of the {CELLS} × {CELLS} cells of that box which a trial visits, "
        f"mean over n trials ± 2 standard errors."
    )


HEIGHT = 3.0
SHOWN = (REFERENCE, "random", "periodic")
GREYS = {"random": "#8a8a8a", "periodic": "#555555"}
DECADES = 4

INNER = slice(1, -1)
"""Neither the zero frequency nor the Nyquist frequency, whose one-sided density counts once."""


@dataclass(frozen=True)
class InputSpectra:
    """Spectra of one environment.

    Attributes
    ----------
    table : pandas.DataFrame
        What is drawn, over the trials of a policy that did not diverge: one row for each policy
        and frequency.
    eigenfrequency : float or None
        Of the linearised system at the stable equilibrium, damping included [Hz].
    gamma : float
        Bound of the inputs, in ``unit``.
    diverged : tuple of str
        Policies of which every trial diverged, and which have no spectrum.
    unit : str
        Unit of the inputs, such as "N".
    """

    env: str
    table: pd.DataFrame
    eigenfrequency: float | None
    gamma: float
    unit: str
    diverged: tuple[str, ...] = ()

    @property
    def by_policy(self) -> dict[str, pd.DataFrame]:
        """The rows of each policy."""
        return {str(name): rows for name, rows in self.table.groupby("policy", sort=False)}


def measure_spectra(reader: Reader, selection: Selection, env: str) -> InputSpectra:
    """Return the spectra of every selected policy of an environment with a finished trial."""
    entries = selection.of(env)
    system = system_of(entries[0].config.config)
    mode = eigenmode(system)
    tables = [_spectrum(reader, entry, system.dt) for entry in entries if entry.final_losses()]
    if not tables:
        raise AnalysisError(
            f"A spectrum of the inputs needs a finished trial, but {env} has none: run the grid."
        )
    return InputSpectra(
        env=env,
        table=pd.concat(tables, ignore_index=True),
        eigenfrequency=mode.frequency / (2 * math.pi) if mode else None,
        gamma=system.gamma,
        unit=unit_of(system.input_labels[0], ""),
        diverged=tuple(
            one.config.policy for one in entries if one.finished and not one.final_losses()
        ),
    )


def _spectrum(reader: Reader, entry: Entry, dt: float) -> pd.DataFrame:
    key, done = entry.config.config_key, entry.final_losses()
    inputs = np.stack([reader.trajectory(key, seed).inputs for seed in done])
    names = {"env": entry.config.env, "policy": entry.config.policy}
    counts = {"n": len(done), "n_diverged": len(entry.finished) - len(done)}
    return pd.DataFrame({**names, **average_spectrum(inputs, dt), **counts})


def spectrum_plot(env: str) -> Plot[InputSpectra]:
    """Return the spectra of one environment's inputs."""
    return Plot(
        title=f"Spectral density of the inputs, {environment_title(env)}",
        statistic="mean over trials of the one-sided periodogram (boxcar, no detrending)",
        band="10 % to 90 % quantiles over trials of the D-optimal density",
        part=lambda selection, _: selection.only([env], SHOWN).compared(),
        measure=lambda reader, selection, _: measure_spectra(reader, selection, env),
        tabulate=lambda spectra: spectra.table,
        draw=draw_spectra,
        caption=spectrum_caption,
    )


def draw_spectra(spectra: InputSpectra) -> Figure:
    """Draw all spectra on logarithmic axes, between the zero and the Nyquist frequency."""
    figure, [[axes]] = sheet(1, 1, HEIGHT, width=COLUMN_WIDTH)
    found = {name: rows[INNER] for name, rows in spectra.by_policy.items()}
    for name, rows in reversed(found.items()):
        _line(axes, name, rows)
    log_scale(axes, *_spectrum_limits(pd.concat(found.values())))
    frequency = next(iter(found.values()))["frequency_hz"]
    log_scale(axes, frequency.iloc[0], frequency.iloc[-1], "x")
    axes.set_xlabel("frequency [Hz]")
    unit = f"({spectra.unit})" if " " in spectra.unit else spectra.unit
    axes.set_ylabel(f"power spectral density of u [{unit}²/Hz]")
    _mark(axes, spectra.eigenfrequency)
    handles, labels = axes.get_legend_handles_labels()
    legend_below(figure, 2, handles=handles[::-1], labels=labels[::-1], fontsize=6.5)
    return figure


def _line(axes: Axes, policy: str, rows: pd.DataFrame) -> None:
    style = policy_style(policy)
    colour, f = GREYS.get(policy, style.colour), rows["frequency_hz"]
    counts = but_diverged(*rows[["n", "n_diverged"]].iloc[0])
    if policy == REFERENCE:
        label = f"{style.label}, 10–90 % of trials"
        ends = rows["quantile_10"], rows["quantile_90"]
        axes.fill_between(f, *ends, color=colour, alpha=0.2, lw=0, label=label)
    label = f"{style.label}, mean (n = {counts})"
    axes.plot(f, rows["mean"], color=colour, ls=style.line, lw=style.width, label=label)


def _spectrum_limits(rows: pd.DataFrame) -> tuple[float, float]:
    """Return limits over everything but leakage more than DECADES below the peak."""
    values = rows[["mean", "quantile_90"]].to_numpy()
    top = float(values.max()) or 1.0
    usable = values[values > top * 10.0**-DECADES]
    return float(usable.min() if len(usable) else top / 10) / 2, top * 3


def _mark(axes: Axes, frequency: float | None) -> None:
    if frequency is None:
        return
    for factor, text in ((1, f"f₀ = {frequency:.3g} Hz"), (3, "3f₀")):
        axes.axvline(factor * frequency, **GUIDE, zorder=1.5)
        axes.annotate(
            text, (factor * frequency, 0.03), xycoords=("data", "axes fraction"), xytext=(2, 0),
            textcoords="offset points", rotation=90, fontsize=6.5, va="bottom", ha="left",
        )  # fmt: skip


def spectrum_caption(spectra: InputSpectra) -> str:
    """Return the caption, with the definition of density and lines."""
    lines = ""
    if spectra.eigenfrequency is not None:
        lines = (
            f" Dashed lines: eigenfrequency f₀ = {spectra.eigenfrequency:.4g} Hz of the linearised "
            f"system at its stable equilibrium, damping included, and its third harmonic."
        )
    if spectra.diverged:
        lines += f" Not drawn, because every trial diverged: {', '.join(spectra.diverged)}."
    found = spectra.by_policy
    counts = count_text({name: str(rows["n"].iloc[0]) for name, rows in found.items()})
    grey = " and ".join(name for name in found if name in GREYS)
    grey += " in grey; " if grey else ""
    return (
        f"Power spectral density of the inputs in the {environment_title(spectra.env)}: one-sided "
        f"periodogram of every trial (boxcar window, no detrending; its integral is the mean "
        f"square of the input; γ² = {spectra.gamma**2:g}), mean over trials; band: 10 % to "
        f"90 % quantiles over D-optimal trials; {grey}zero and Nyquist frequency not "
        f"drawn.{lines} Trials: {counts}."
    )
