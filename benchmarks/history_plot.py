"""Picture of a history: how each row changed from run to run, a panel for each question."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from analysis.figures.panels import rows_and_columns
from benchmarks.history import SLOWER, Run, costs

PANEL = (5.0, 2.6)
"""Size of a panel [inches]."""


def draw(runs: Sequence[Run], path: Path) -> None:
    """Draw the cost of each row over its median against the number of the run."""
    questions = list(dict.fromkeys(_question(name) for name in costs(runs)))
    height, width = rows_and_columns(max(1, len(questions)), widest=3)
    size = (PANEL[0] * width, PANEL[1] * height)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(height, width, squeeze=False, sharex=True).flat
    for axes, question in zip(panels, questions, strict=False):
        _panel(axes, question, runs)
    for axes in list(panels)[len(questions) :]:
        axes.set_visible(False)
    figure.supxlabel("run")
    figure.supylabel("time over the median of the runs, both in times of the calibration")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _panel(axes: Axes, question: str, runs: Sequence[Run]) -> None:
    for name, past in costs(runs).items():
        if _question(name) == question:
            numbers = [i for i, run in enumerate(runs, start=1) if name in run.rows]
            label = name.removeprefix(f"{question}: ")
            relative = [cost / median(past) for cost in past]
            axes.plot(numbers, relative, marker="o", markersize=3, label=label)
    axes.axhline(SLOWER, color="black", lw=0.8, ls=(0, (5, 2)))
    axes.set_title(question)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(fontsize=6)


def _question(name: str) -> str:
    return name.partition(": ")[0]
