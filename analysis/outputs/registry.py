"""All outputs of ``analysis figures``, by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
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
from analysis.outputs import publish
from analysis.outputs.names import NAMES, partial_warning
from analysis.outputs.page import NAME as PAGE
from analysis.outputs.page import write_page
from analysis.plot_options import PlotOptions
from analysis.tables.registry import TABLES, TableKind
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


def build(
    reader: Reader,
    selection: Selection,
    options: PlotOptions,
    folder: Path,
    names: tuple[str, ...] = NAMES,
    *,
    force: bool = False,
) -> Iterator[Outcome]:
    """Write the named outputs and the page of all into a folder; say of each what happened."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        part = _part(name, selection, options)
        if not part.entries:
            yield Outcome(name, "not drawn, nothing is stored for it")
            continue
        facts = provenance.describe(reader, part) | {"request": options.as_dict(), "name": name}
        mark = _mark(facts)
        endings = (*publish.PICTURES, "csv", "txt") if name in PLOTS else TABLE_FILES
        if not force and publish.is_current(folder, name, endings, mark):
            yield Outcome(name, "unchanged")
            continue
        if name in PLOTS:
            facts |= _draw(PLOTS[name], reader, part, options, folder, mark)
        else:
            facts |= _tabulate(name, TABLES[name], reader, part, options, folder)
        publish.write_provenance(facts | {"fingerprint": mark}, folder, name)
        yield Outcome(name, "written")
    if write_page(folder, PLOTS, TABLES):
        yield Outcome(PAGE, "written")


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


def _draw(
    plot: Plot[Any],
    reader: Reader,
    selection: Selection,
    options: PlotOptions,
    folder: Path,
    mark: str,
) -> dict[str, str]:
    with styled():
        drawing = plot.make(reader, selection, options)
        caption = drawing.caption
        if selection.gaps:
            warning = partial_warning(selection)
            caption = f"{warning} {caption}"
            drawing.figure.suptitle(warning, fontsize=8, color="#b00020", weight="bold")
        publish.write_pictures(drawing.figure, folder, plot.name, plot.title, mark)
    publish.write_table(drawing.table, folder, plot.name)
    publish.write_text(caption + "\n", folder / f"{plot.name}.txt")
    return plot.words(options) | {"caption": caption}


def _tabulate(
    name: str,
    kind: TableKind,
    reader: Reader,
    selection: Selection,
    options: PlotOptions,
    folder: Path,
) -> dict[str, str]:
    table = kind.measure(reader, selection, options)
    text_table = kind.render(table, options)
    warning = f"{partial_warning(selection)}\n\n" if selection.gaps else ""
    publish.write_table(table, folder, name)
    publish.write_text(warning + text_table.markdown(), folder / f"{name}.md")
    publish.write_text(_commented(warning) + text_table.latex(), folder / f"{name}.tex")
    return {"title": kind.title, "caption": warning + text_table.note}


def _commented(warning: str) -> str:
    return f"% {warning.rstrip()}\n" if warning else ""
