"""``python -m analysis report``: compare everything that was run, on one page."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable

from analysis.data import provenance
from analysis.data.config_matching import Filter
from analysis.data.missing_trials import Gap
from analysis.data.trial_selection import Selection
from analysis.errors import IncompleteError
from analysis.outputs import publish
from analysis.report import control, page, variant_table
from analysis.report.variants import VariantGroup, variant_groups
from analysis.tables.rendering import gaps_table
from orchestrate.cli_parser import path
from orchestrate.files import make_folder
from orchestrate.store import Reader

HELP = "compare every policy, model and learner with the reference, on one page"
NAME = "report"
CONTROL = f"{NAME}_control"
PAGE = "README.md"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that only this command has."""
    parser.add_argument("--out", type=path("--out"), default="report", help="folder (report/)")


def run(options: argparse.Namespace, wanted: Filter) -> int:
    """Write the page, the pictures, the CSV and the provenance; 0."""
    from analysis.figures.style import styled  # Matplotlib: other commands do without it
    from analysis.report import forest_plot

    with Reader.open(options.db) as reader, reader.moment() as moment:
        found = variant_groups(moment, wanted)
        gaps = [gap for group in found for gap in _gaps(group)]
        if gaps and not options.allow_partial:
            raise IncompleteError(_refusal(gaps))
        table = variant_table.adjust(
            [variant_table.tabulate_group(moment, group, options.diverged) for group in found]
        )
        controlled = control.tabulate(moment, found)
        selection = Selection(tuple(one for group in found for one in group.variants))
        facts = provenance.describe(moment, selection)
    make_folder(options.out)
    pictures = {}
    with styled():
        mark = publish.fingerprint({"cells": facts["cells"], "selection": facts["selection"]})
        for env, rows in table.groupby("env", sort=False):
            pictures[str(env)] = f"{NAME}_{env}"
            title = f"Ratios of final losses: {env}"
            publish.write_pictures(
                forest_plot.draw(rows), options.out, pictures[str(env)], title, mark
            )
    publish.write_table(table, options.out, NAME)
    if controlled is not None:
        publish.write_table(controlled, options.out, CONTROL)
    notes = [f"{group.env}: {note}" for group in found for note in group.notes]
    if gaps:
        notes.insert(0, f"PARTIAL: {sum(len(gap.seeds) for gap in gaps)} trials are missing")
    text = page.write(
        table,
        notes,
        _origin(facts, controlled=controlled is not None),
        pictures,
        [] if controlled is None else [control.section(controlled)],
    )
    publish.write_text(text, options.out / PAGE)
    publish.write_provenance(facts, options.out, NAME)
    sys.stdout.write(f"{options.out / PAGE}: {len(table)} variants\n")
    return 0


def _origin(facts: dict[str, object], *, controlled: bool) -> str:
    versions = facts["versions"]
    assert isinstance(versions, dict)
    configs = facts["cells"]
    assert isinstance(configs, list)
    trials = sum(config["n_finished"] for config in configs)
    control = f" and [{CONTROL}.csv]({CONTROL}.csv)" if controlled else ""
    return (
        f"Made by dopt {versions['dopt']} from {trials:,} trials of {len(configs)} configurations "
        f"in `{facts['database']}`. The numbers are in [{NAME}.csv]({NAME}.csv){control}, where "
        f"they come from in [{NAME}.json]({NAME}.json)."
    )


def _gaps(group: VariantGroup) -> Iterable[Gap]:
    """Yield what is registered of a variant and not finished.

    Variants may have different numbers of seeds: a ratio is over the shared ones.
    """
    for one in group.variants:
        missing = {trial.seed for trial in one.trials} - {trial.seed for trial in one.finished}
        if missing:
            yield Gap(group.env, one.label, tuple(sorted(missing)), f"{len(missing)} not finished")


def _refusal(gaps: list[Gap]) -> str:
    missing = sum(len(gap.seeds) for gap in gaps)
    return (
        f"{gaps_table(gaps).markdown()}\n\nerror: {missing} trials are missing, but all that are "
        f"registered are expected: run the launch again, narrow the request by --env, --policy "
        f"and --where, or give --allow-partial to go on with what there is."
    )
