"""Command ``merge OTHER``: copy the trials of another results database into this one."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence

from dopt.given_path import given_path
from orchestrate.cli_parser import UsageError
from orchestrate.commands.command import Command
from orchestrate.commands.doctor import trial_key
from orchestrate.commands.output import say, say_json
from orchestrate.errors import ExitCode
from orchestrate.store.merging.merge import Merged, TrialName, merge
from orchestrate.store.shards import merge_collected

MAX_LISTED = 10
"""Trials of a kind that are listed; the JSON has all of them."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "other",
        metavar="OTHER",
        help="file or URL of the other database, or folder of a bundle or of shards",
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    """Merge and print the counts; exit code 1 if trials that have an outcome were left out."""
    merged = _merge(arguments.db, arguments.other)
    if arguments.json:
        say_json({**_plain(merged), "changed": merged.changed})
    else:
        say("\n".join(_lines(merged)))
    refused = merged.conflicts or merged.incomplete or merged.contradictory
    return ExitCode.SOME_FAILED if refused else ExitCode.DONE


def _merge(url: str, other: str) -> Merged:
    if "://" in other:
        return merge(url, other, trial_key)
    place = given_path(other, "OTHER", UsageError)
    if not place.is_dir():
        return merge(url, f"sqlite:///{place.absolute()}", trial_key)
    if not any(place.glob("*.db")):  # a bundle has other files
        from orchestrate.store.bundle import merge_bundle

        return merge_bundle(url, place, trial_key)
    total = Merged()
    for merged in merge_collected(url, place, trial_key=trial_key):
        total.include(merged)
    return total


def _plain(merged: Merged) -> dict[str, object]:
    return dataclasses.asdict(merged)


def _lines(merged: Merged) -> list[str]:
    added = ", ".join(f"{count:,} {status}" for status, count in sorted(merged.added.items()))
    lines = [f"copied {sum(merged.added.values()):,} trials{f' ({added})' if added else ''}"]
    told = {
        f"{merged.identical:,} exist here with equal numbers": merged.identical,
        f"{merged.kept:,} failed there and have an outcome here": merged.kept,
        f"{merged.running:,} are running here": merged.running,
    }
    lines += [line for line, count in told.items() if count]
    lines += _listed("have different numbers here and were not copied", merged.conflicts)
    lines += _listed("are incomplete there and were not copied", merged.incomplete)
    what = "contradict their keys or the shapes of their arrays there and were not copied"
    lines += _listed(what, merged.contradictory)
    return lines


def _listed(what: str, trials: Sequence[TrialName]) -> list[str]:
    if not trials:
        return []
    rest = [f"  and {len(trials) - MAX_LISTED:,} more"] if len(trials) > MAX_LISTED else []
    names = [f"  {one.trial_key[:12]}  {one.env} {one.policy} seed {one.seed}" for one in trials]
    return [f"{len(trials):,} {what}:", *names[:MAX_LISTED], *rest]


COMMAND = Command("merge", "copy the trials of another database", add_arguments, run)
