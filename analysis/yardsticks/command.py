"""``python -m analysis yardsticks``: published tables, run here, beside the published numbers."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from analysis.data import provenance
from analysis.data.config_matching import Filter
from analysis.data.trial_selection import Selection
from analysis.errors import IncompleteError
from analysis.outputs import publish
from analysis.yardsticks import pendulum_rows
from orchestrate.store import Reader

HELP = "published tables, run here, beside the published numbers"
NAME = "flex_table3"
TRIALS = f"{NAME}_trials"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that only this command has."""
    parser.add_argument("--out", type=Path, default=Path("yardsticks"), help="folder (yardsticks/)")


def run(options: argparse.Namespace, wanted: Filter) -> int:
    """Print the tables, and write their CSV files and the provenance; 0."""
    with Reader.open(options.db) as reader, reader.moment() as moment:
        found = pendulum_rows.entries(moment, wanted)
        unfinished = sum(len(entry.trials) - len(entry.finished) for entry in found)
        if unfinished and not options.allow_partial:
            raise IncompleteError(
                f"error: {unfinished} trials are not finished, a complete grid is expected: run "
                f"the launch again, or give --allow-partial to go on with what there is."
            )
        trials = pendulum_rows.measure(moment, found)
        facts = provenance.describe(moment, Selection(tuple(found))) | {"name": NAME}
    table = pendulum_rows.tabulate(trials)
    options.out.mkdir(parents=True, exist_ok=True)
    publish.write_table(trials, options.out, TRIALS)
    publish.write_table(table, options.out, NAME)
    publish.write_provenance(facts, options.out, NAME)
    parts = (pendulum_rows.samples_table(table), pendulum_rows.ratio_table(table))
    sys.stdout.write("\n".join(part.markdown() for part in parts))
    return 0
