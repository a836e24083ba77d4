"""All outputs of ``analysis figures``, by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from analysis.data import provenance
from analysis.data.trial_selection import Selection
from analysis.figures.control.plot import control_plot
from analysis.figures.input_spectrum.plot import spectrum_plot
from analysis.figures.limits.plot import limits_plot
from analysis.figures.loss_curves.plot import loss_plot
from analysis.figures.pareto.plot import pareto_plot
from analysis.figures.phase_portraits.plot import phase_plot
from analysis.figures.plot import Plot
from analysis.figures.profiles.plot import profiles_plot
from analysis.figures.sensitivity.plot import sensitivity_plot
from analysis.figures.style import styled
from analysis.figures.width.plot import cost_plot, loss_against_width_plot
from analysis.outputs import processes, publish
from analysis.outputs.names import NAMES, partial_warning
from analysis.outputs.page import NAME as PAGE
from analysis.outputs.page import write_page
from analysis.plot_options import PlotOptions
from analysis.tables.registry import TABLES, TableKind
from orchestrate.files import make_folder
from orchestrate.store import Reader

PLOTS: dict[str, Plot[Any]] = {
    plot.name: plot
    for plot in (
        loss_plot("figure1", "loss"),
        loss_plot("figure1_reachable", "reachable_loss"),
        phase_plot("pendulum"),
        phase_plot("cartpole"),
        spectrum_plot("cartpole", "figure2_spectrum"),
        cost_plot("figure4_width"),
        loss_against_width_plot("figure4_width_loss"),
        control_plot("figure5_control"),
        pareto_plot("figure6_pareto"),
        profiles_plot("figure7_profiles"),
        sensitivity_plot("figure8_sensitivity"),
        limits_plot("figure9_limits"),
    )
}
WITH_EXPLORATIONS = ("figure1", *(name for name in PLOTS if name.startswith("figure2")), "summary")
"""Outputs that compare no losses, and so show explorations too."""

TABLE_FILES = ("md", "tex", "csv")


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What happened to one output: drawn, unchanged, or nothing stored for it."""

    name: str
    state: str


@dataclasses.dataclass(frozen=True)
class Task:
    """An output that is to be written: its trials, its provenance and its fingerprint."""

    name: str
    selection: Selection
    options: PlotOptions
    folder: Path
    facts: Mapping[str, Any]
    mark: str


def build(
    reader: Reader,
    selection: Selection,
    options: PlotOptions,
    folder: Path,
    names: tuple[str, ...] = NAMES,
    *,
    force: bool = False,
    workers: int = 1,
) -> Iterator[Outcome]:
    """Write the named outputs and the page of all into a folder; say of each what happened.

    ``workers`` outputs are written at a time, each in a process of its own if there are several.
    """
    make_folder(folder)
    planned = {name: _plan(name, reader, selection, options, folder, force) for name in names}
    tasks = {name: one for name, one in planned.items() if isinstance(one, Task)}
    with processes.written(_write, reader, tasks, workers) as write:
        for name, one in planned.items():
            if isinstance(one, str):
                yield Outcome(name, one)
            else:
                write(name)
                yield Outcome(name, "written")
    if write_page(folder, PLOTS, TABLES):
        yield Outcome(PAGE, "written")


def _plan(
    name: str,
    reader: Reader,
    selection: Selection,
    options: PlotOptions,
    folder: Path,
    force: bool,
) -> Task | str:
    """Return what is to be written, or why nothing is."""
    part = _part(name, selection, options)
    if not part.entries:
        return "not drawn, nothing is stored for it"
    facts = provenance.describe(reader, part) | {"request": options.as_dict(), "name": name}
    mark = _mark(facts)
    endings = (*publish.PICTURES, "csv", "txt") if name in PLOTS else TABLE_FILES
    if not force and publish.is_current(folder, name, endings, mark):
        return "unchanged"
    return Task(name, part, options, folder, facts, mark)


def _write(reader: Reader, task: Task) -> None:
    if task.name in PLOTS:
        words = _draw(PLOTS[task.name], reader, task)
    else:
        words = _tabulate(TABLES[task.name], reader, task)
    facts = {**task.facts, **words, "fingerprint": task.mark}
    publish.write_provenance(facts, task.folder, task.name)


def _part(name: str, selection: Selection, options: PlotOptions) -> Selection:
    if name not in WITH_EXPLORATIONS:
        selection = selection.simulated()
    if name in PLOTS:
        return PLOTS[name].part(selection)
    return TABLES[name].part(selection, options)


def _mark(facts: dict[str, Any]) -> str:
    """Return the fingerprint; where the data lie and which commit was checked out is no part."""
    parts = ("selection", "request", "versions", "name", "notes")
    content = {key: facts[key] for key in parts} | {"code": provenance.code_hash()}
    return publish.fingerprint(content)


def _draw(plot: Plot[Any], reader: Reader, task: Task) -> dict[str, str]:
    folder = task.folder
    with styled():
        drawing = plot.make(reader, task.selection, task.options)
        caption = drawing.caption
        if task.selection.gaps:
            warning = partial_warning(task.selection)
            caption = f"{warning} {caption}"
            drawing.figure.suptitle(warning, fontsize=8, color="#b00020", weight="bold")
        publish.write_pictures(drawing.figure, folder, plot.name, plot.title, task.mark)
    publish.write_table(drawing.table, folder, plot.name)
    publish.write_text(caption + "\n", folder / f"{plot.name}.txt")
    return plot.words(task.options) | {"caption": caption}


def _tabulate(kind: TableKind, reader: Reader, task: Task) -> dict[str, str]:
    name, folder = task.name, task.folder
    table = kind.measure(reader, task.selection, task.options)
    text_table = kind.render(table, task.options)
    warning = f"{partial_warning(task.selection)}\n\n" if task.selection.gaps else ""
    publish.write_table(table, folder, name)
    publish.write_text(warning + text_table.markdown(), folder / f"{name}.md")
    publish.write_text(_commented(warning) + text_table.latex(), folder / f"{name}.tex")
    return {"title": kind.title, "caption": warning + text_table.note}


def _commented(warning: str) -> str:
    return f"% {warning.rstrip()}\n" if warning else ""
