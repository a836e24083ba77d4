"""Pictures of reports: ratios of final losses, a fitted plant, the health of a log."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.data.matching import APART
from analysis.figures.panels import (
    GUIDE,
    TEXT_WIDTH,
    half_widths,
    legend_below,
    log_scale,
    log_ticks,
    sheet,
    styled,
)
from analysis.log_health import LAGS, Health, Signal
from analysis.style import BLUE, GREY, SEQUENCE, VERMILLION
from analysis.tables.rendering import records
from analysis.tables.variants import verdict
from dopt.log import Log
from orchestrate.errors import whole

if TYPE_CHECKING:
    from dopt.fitting.fitted import Fitted

_LOOK = {"better": (BLUE, "o"), "worse": (VERMILLION, "s"), "open": (GREY, "D")}
_INCHES_PER_ROW = 0.16
_INCHES_AROUND = 0.62


def draw_forest(part: pd.DataFrame) -> Figure:
    """Return the figure of one system's rows of :func:`analysis.tables.variants.adjust`."""
    known = part[part["loss_ratio"].notna() & (part["policy"] != APART)]
    rows = known.sort_values("loss_ratio", ascending=False, kind="stable")
    height = _INCHES_AROUND + _INCHES_PER_ROW * len(rows)
    figure, [[axes]] = sheet(1, 1, height, width=TEXT_WIDTH)
    _fill(axes, rows)
    axes.set_xlabel(f"final loss / final loss of {part['variant'].iloc[0]}")
    return figure


def _fill(axes: Axes, part: pd.DataFrame) -> None:
    for place, row in enumerate(records(part)):
        colour, marker = _LOOK[verdict(row)]
        ends = [[row[f"loss_{name}"]] for name in ("ratio", "low", "high")]
        axes.errorbar(
            ends[0],
            place,
            xerr=half_widths(*ends),
            fmt=marker,
            color=colour,
            ms=3.5,
            elinewidth=1.0,
        )
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_xscale("log")
    log_ticks(axes.xaxis, *axes.get_xlim())
    axes.set_yticks(range(len(part)), list(part["variant"]), fontsize=6.5)
    axes.set_ylim(-0.7, len(part) - 0.3)
    axes.grid(axis="y", visible=False)


SHOWN = 12.0
"""Length of the run that is shown, by the length of the windows of the fit."""

COLOURS = {"model": "C0", "physics alone": "C1", "linear": "C2", "nothing changes": "0.5"}


def draw_fit(found: Fitted, log: Log, target: Path) -> None:
    """Draw a fit and save the picture.

    Parameters
    ----------
    found : dopt.fitting.fitted.Fitted
    log : dopt.Log
        Run whose longest piece is shown.
    target : Path
    """
    from dopt.fitting.model import measured_names  # loads numba

    names = list(measured_names(found.plant))
    with styled():
        figure = Figure((TEXT_WIDTH, 1.0 + 1.6 * len(names)), layout="constrained")
        panels = figure.subplots(len(names), 2, squeeze=False, width_ratios=(3, 2))
        _run(found, log, names, panels[:, 0])
        _errors(found, names, panels[:, 1])
        legend_below(figure, 5)
        target.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(target)


def _run(found: Fitted, log: Log, measured: list[str], panels: np.ndarray) -> None:
    longest = max(range(len(log.pieces)), key=lambda i: len(log.pieces[i].time))
    piece = log.pieces[longest]
    simulated = max(found.simulate(log), key=lambda each: len(each.time))
    begin = simulated.time[0]
    end = begin + SHOWN * found.selection.window
    part, seen = simulated.time <= end, (piece.time >= begin) & (piece.time <= end)
    states = [list(found.plant.states).index(name) for name in measured]
    for c, (name, axes) in enumerate(zip(measured, panels, strict=True)):
        column = piece.measured[seen, log.states.index(name)]
        t = simulated.time[part] - begin
        axes.plot(piece.time[seen] - begin, column, color="black", lw=0.8, label="measured")
        axes.plot(t, simulated.states[part, states[c]], color="C0", label="model")
        low, high = simulated.lower[part, c], simulated.upper[part, c]
        axes.fill_between(t, low, high, color="C0", alpha=0.18, lw=0)
        axes.set(ylabel=f"{name} [{found.plant.states[name]}]")
    panels[-1].set(xlabel="time [s]")
    panels[0].set(title="free run, bounds of 90 %")


def _errors(found: Fitted, measured: list[str], panels: np.ndarray) -> None:
    rows = found.errors()
    for name, axes in zip(measured, panels, strict=True):
        own = [row for row in rows if row["state"] == name]
        for what in ("model", "physics alone", "linear"):
            here = [row for row in own if row["model"] == what]
            x = [row["horizon"] for row in here]
            if here and (what != "physics alone" or found.has_network):
                y = [row["rms"] for row in here]
                label = None if what == "model" else what  # which the run has
                axes.plot(x, y, color=COLOURS[what], marker=".", label=label)
            if what == "model":
                y = [row["nothing_changes"] for row in here]
                axes.plot(x, y, color=COLOURS["nothing changes"], ls=":", label="nothing changes")
        if own:
            horizons = [row["horizon"] for row in own]
            log_scale(axes, 0.9 * min(horizons), 1.1 * max(horizons), "x")
        axes.set(yscale="log", ylabel=f"error [{found.plant.states[name]}]")
    where = "runs for validation" if found.tests else "held-out blocks"
    panels[0].set(title=f"errors on {where}")
    panels[-1].set(xlabel="time ahead [s]")


DRAWN = 4000
"""Points of a line; a longer log is drawn as the extremes of as many stretches."""

MOST = 8
"""Signals that are drawn."""


def draw_log(log: Log, health: Health, target: Path, title: str) -> None:
    """Draw a log and write the picture, whose ending says its format."""
    signals = [*health.states, *health.inputs][:MOST]
    with styled():
        figure, axes = sheet(len(signals) + 1, 1, 0.85, 0.9, TEXT_WIDTH)
        figure.set_layout_engine(None)  # its solver takes a second
        figure.subplots_adjust(left=0.11, right=0.98, top=0.95, bottom=0.11, hspace=0.4)
        for panel, signal in zip(axes[:-1, 0], signals, strict=True):
            _draw_signal(panel, log, signal, health)
        axes[-2, 0].set_xlabel("time [s]")
        place = axes[-1, 0].get_position()
        axes[-1, 0].remove()
        low, tall = place.y0, place.height * 0.8
        _draw_steps(figure.add_axes((place.x0, low, 0.4, tall)), log)
        _draw_lags(figure.add_axes((0.59, low, 0.39, tall)), health)
        figure.suptitle(title, fontsize=8.5, y=0.99)
        with whole(target) as part:
            figure.savefig(part, format=target.suffix[1:], dpi=130)


def _draw_signal(panel: Axes, log: Log, signal: Signal, health: Health) -> None:
    is_state = signal.name in log.states
    i = (log.states if is_state else log.inputs).index(signal.name)
    times, values = [], []
    for piece in log.pieces:
        found = (piece.measured if is_state else piece.inputs)[:, i]
        shown = _extremes(found, log.n_rows)
        times.append([*piece.time[shown], piece.time[-1]])
        values.append([*found[shown], np.nan])  # where the line ends
    style: dict[str, Any] = {"color": BLUE} if is_state else {"color": SEQUENCE[2]}
    style |= {} if is_state else {"drawstyle": "steps-post"}
    panel.plot(np.concatenate(times), np.concatenate(values), lw=0.7, **style)
    pairs = zip(log.pieces, log.pieces[1:], strict=False)
    _shade(panel, [(one.time[-1], other.time[0]) for one, other in pairs], VERMILLION)
    for number, level in ((signal.at_low, signal.low), (signal.at_high, signal.high)):
        if number and not is_state:
            panel.axhline(level, **{**GUIDE, "color": VERMILLION})
    every = np.concatenate([piece.time for piece in log.pieces])
    bounds = every[np.linspace(0, len(every) - 1, len(health.resting) + 1).astype(int)]
    _shade(panel, [(bounds[k], bounds[k + 1]) for k in np.flatnonzero(health.resting)], GREY)
    panel.set_ylabel(signal.name)


def _shade(panel: Axes, spans: Sequence[tuple[float, float]], colour: str) -> None:
    """Shade stretches of time over the height of a panel."""
    bars = [(start, end - start) for start, end in spans]
    over = panel.get_xaxis_transform()
    panel.broken_barh(bars, (0, 1), transform=over, color=colour, alpha=0.25, lw=0)


def _extremes(values: Any, n_rows: int) -> Any:
    """Return places of the smallest and largest value of each of many stretches, in order."""
    size = -(-n_rows // (DRAWN // 2))
    if size < 3 or len(values) < size:
        return np.arange(len(values))
    rows = np.arange(len(values) - len(values) % size).reshape(-1, size)
    known = np.where(np.isfinite(values), values, 0.0)[rows]
    both = np.column_stack([known.argmin(axis=1), known.argmax(axis=1)])
    return (rows[:, :1] + np.sort(both, axis=1)).ravel()


def _draw_steps(panel: Axes, log: Log) -> None:
    steps = 1e3 * np.concatenate([np.diff(piece.time) for piece in log.pieces])
    span = max(float(np.ptp(steps)), 0.1 * float(steps.max()))
    low = float(steps.min()) - 0.05 * span
    panel.hist(steps, bins=60, range=(low, low + 1.1 * span), color=BLUE, log=True)
    panel.set(xlabel="step [ms]", ylabel="rows")


def _draw_lags(panel: Axes, health: Health) -> None:
    for colour, effect in zip(SEQUENCE, health.effects, strict=False):
        label = f"{effect.input} on {effect.state}"
        panel.plot(LAGS, effect.explained, color=colour, marker=".", label=label)
    panel.set(xlabel="lag [samples]", ylabel="explained", ylim=(-0.02, 1.02))
    if health.effects:
        panel.legend(fontsize=6)
