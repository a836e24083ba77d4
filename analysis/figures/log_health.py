"""Picture of the health of a log: signals with gaps, limits and rest, steps, and lags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from analysis.figures.panels import GUIDE, TEXT_WIDTH, sheet, styled
from analysis.logs.excitation import LAGS
from analysis.logs.health import Health, Signal
from analysis.style import BLUE, GREY, SEQUENCE, VERMILLION
from dopt.log import Log
from orchestrate.files import whole

DRAWN = 4000
"""Points of a line; a longer log is drawn as the extremes of as many stretches."""

MOST = 8
"""Signals that are drawn."""


def save(log: Log, health: Health, target: Path, title: str) -> None:
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
