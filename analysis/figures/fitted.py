"""Picture of a fitted plant: a run with its simulation, and errors against the time ahead."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from analysis.figures.panels import TEXT_WIDTH, legend_below, log_scale, styled
from dopt.fitting.fitted import Fitted
from dopt.fitting.model import measured_names
from dopt.log import Log

SHOWN = 12.0
"""Length of the run that is shown, by the length of the windows of the fit."""

COLOURS = {"model": "C0", "physics alone": "C1", "linear": "C2", "nothing changes": "0.5"}


def save(found: Fitted, log: Log, target: Path) -> None:
    """Draw a fit and save the picture.

    Parameters
    ----------
    found : dopt.fitting.fitted.Fitted
    log : dopt.Log
        Run whose longest piece is shown.
    target : Path
    """
    names = measured_names(found.plant)
    with styled():
        figure = Figure((TEXT_WIDTH, 1.0 + 1.6 * len(names)), layout="constrained")
        panels = figure.subplots(len(names), 2, squeeze=False, width_ratios=(3, 2))
        _run(found, log, panels[:, 0])
        _errors(found, panels[:, 1])
        legend_below(figure, 5)
        target.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(target)


def _run(found: Fitted, log: Log, panels: np.ndarray) -> None:
    longest = max(range(len(log.pieces)), key=lambda i: len(log.pieces[i].time))
    piece = log.pieces[longest]
    simulated = max(found.simulate(log), key=lambda each: len(each.time))
    begin = simulated.time[0]
    end = begin + SHOWN * found.selection.window
    part, seen = simulated.time <= end, (piece.time >= begin) & (piece.time <= end)
    measured = measured_names(found.plant)
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


def _errors(found: Fitted, panels: np.ndarray) -> None:
    rows = found.errors()
    for name, axes in zip(measured_names(found.plant), panels, strict=True):
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
