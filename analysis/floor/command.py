"""``python -m analysis floor``: offline fits of stored trials, and the error budgets from them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from typing import Any

import pandas as pd

from analysis.data import provenance
from analysis.data.trial_selection import Selection
from analysis.errors import AnalysisError
from analysis.figures.error_budget.data import Budget, budgets, tabulate
from analysis.floor.trial_fits import fit_trials, with_offline_fit
from analysis.outputs import publish
from analysis.outputs.names import partial_warning
from analysis.tables.error_budget import budget_table
from analysis.tables.rendering import TextTable
from analysis.units import loss_unit
from analysis.workers_option import add_workers
from dopt.offline_fit import RIDGE
from dopt.spec.prequential import system_of
from orchestrate.cli_parser import path, tell
from orchestrate.files import make_folder
from orchestrate.store import Reader

HELP = "fit the models of stored trials offline: how much exploration and learner lose"
NAME = "error_budget"
TRIALS = f"{NAME}_trials"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that only this command has."""
    parser.add_argument("--out", type=path("--out"), default="floor", help="folder (floor/)")
    parser.add_argument(
        "--ridge",
        type=float,
        default=RIDGE,
        help=f"weight that draws a fit to the initial parameters ({RIDGE:g})",
    )
    add_workers(parser, "fits")


def run(
    reader: Reader, selection: Selection, options: argparse.Namespace
) -> tuple[TextTable, pd.DataFrame]:
    """Fit, write the picture, the CSV files and the provenance; return the table of budgets."""
    fitted = with_offline_fit(selection)
    for note in fitted.notes[len(selection.notes) :]:
        _progress(f"note: {note}")
    trials = fit_trials(reader, fitted, options.ridge, options.workers, _progress)
    if trials.empty:
        raise AnalysisError(
            "Every selected trial diverged, but an error budget needs some that did not: run "
            "others, or ask for more."
        )
    found = budgets(trials)
    request = {"ridge": options.ridge}
    facts = provenance.describe(reader, fitted) | {"request": request, "name": NAME}
    make_folder(options.out)
    publish.write_table(trials, options.out, TRIALS)
    facts |= _draw(found, fitted, options, facts)
    table = tabulate(found)
    publish.write_table(table, options.out, NAME)
    publish.write_provenance(facts, options.out, NAME)
    _progress(f"{options.out / NAME}: written")
    return budget_table(table), table


def _draw(
    found: tuple[Budget, ...],
    selection: Selection,
    options: argparse.Namespace,
    facts: Mapping[str, Any],
) -> dict[str, str]:
    """Write the picture and its caption; return what the provenance says of them."""
    from analysis.figures.error_budget import plot  # Matplotlib: other commands do without it
    from analysis.figures.style import styled

    mark = publish.fingerprint({key: facts[key] for key in ("selection", "request", "versions")})
    warning = partial_warning(selection) if selection.gaps else ""
    with styled():
        figure = plot.draw(found, _units(selection))
        if warning:
            figure.suptitle(warning, fontsize=8, color="#b00020", weight="bold")
        publish.write_pictures(figure, options.out, NAME, plot.TITLE, mark)
    caption = f"{warning} {plot.caption(found, options.ridge)}".strip()
    publish.write_text(caption + "\n", options.out / f"{NAME}.txt")
    words = {"title": plot.TITLE, "statistic": plot.STATISTIC, "band": plot.BAND}
    return words | {"caption": caption, "fingerprint": mark}


def _units(selection: Selection) -> dict[str, str]:
    """Return the unit of the loss by environment."""
    return {
        entry.config.env: loss_unit(system_of(entry.config.config)) for entry in selection.entries
    }


def _progress(text: str) -> None:
    tell(sys.stderr, f"{text}\n")  # the output may be a CSV
