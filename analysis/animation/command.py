"""Command ``animate``: its arguments, the selection of the trial, and the output file."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from analysis.animation.replay_data import tell
from analysis.data.config_matching import Filter
from analysis.data.trial_selection import Entry, select
from analysis.errors import AnalysisError
from analysis.figures.phase_portraits.data import median_seed
from orchestrate.cli_parser import path
from orchestrate.store import Reader

HELP = "a film of one stored trial: system, phase trace, learned and true force, loss"


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Declare what the command takes, beside the database."""
    command.add_argument("env", metavar="ENV", help="environment of the trial")
    command.add_argument("policy", metavar="POLICY", help="policy of the trial")
    command.add_argument("--seed", type=int, help="seed (that of the median final loss)")
    command.add_argument("--out", type=path("--out"), help=".gif or .mp4 (figures/ENV_POLICY.gif)")
    command.add_argument("--frames", type=int, default=150, help="pictures in all (150)")
    command.add_argument("--fps", type=int, default=15, help="pictures a second (15)")


def run(options: argparse.Namespace) -> int:
    """Write the film and say where it is."""
    from analysis.animation.writers import shoot  # Matplotlib: other commands do without it

    for name in ("frames", "fps"):
        if getattr(options, name) < 1:
            raise AnalysisError(
                f"--{name} is {getattr(options, name)}, but at least 1 is expected: raise it."
            )
    name = f"{options.env}_{options.policy}.gif".replace("/", "_")
    target = options.out or Path("figures") / name
    with Reader.open(options.db) as reader:
        entry = _entry(reader, options.env, options.policy)
        seed = _median(entry) if options.seed is None else options.seed
        story = tell(reader, entry, seed, options.frames)
    shoot(story, target, options.fps)
    sys.stdout.write(f"{target}: seed {seed}, {len(story.steps)} pictures\n")
    return 0


def _entry(reader: Reader, env: str, policy: str) -> Entry:
    chosen = [
        entry
        for entry in select(reader, Filter(environments=(env,))).entries
        if entry.config.policy == policy
    ]
    if not chosen:
        # Asked for by name, the policy is found or refused with the names there are.
        chosen = list(select(reader, Filter((env,), (policy,))).entries)
    return chosen[0]


def _median(entry: Entry) -> int:
    losses = entry.final_losses()
    if not losses:
        raise AnalysisError(
            f"{entry.config.env} × {entry.config.policy} has no finished trial that did not "
            f"diverge: run one, or give --seed."
        )
    return median_seed(losses)
