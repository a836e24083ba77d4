"""``merge OTHER``: bring the trials of another results database into this one."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

from orchestrate.commands.command import Command
from orchestrate.commands.output import say, say_json
from orchestrate.errors import ExitCode
from orchestrate.store import Merged, Named, merge

SHOWN = 10
"""Trials of a kind that are named; the JSON has all of them."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("other", metavar="OTHER", help="file or URL of the other database")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Merge, and say what came of each trial; exit code 1 where some need a look."""
    merged = merge(arguments.db, _url(arguments.other))
    if arguments.json:
        say_json({**_plain(merged), "changed": merged.changed})
    else:
        say("\n".join(_lines(merged)))
    return ExitCode.SOME_FAILED if merged.conflicts or merged.broken else ExitCode.DONE


def _url(text: str) -> str:
    return text if "://" in text else f"sqlite:///{Path(text).absolute()}"


def _plain(merged: Merged) -> dict[str, object]:
    return dataclasses.asdict(merged)


def _lines(merged: Merged) -> list[str]:
    added = ", ".join(f"{count:,} {status}" for status, count in sorted(merged.added.items()))
    lines = [f"brought {sum(merged.added.values()):,} trials{f' ({added})' if added else ''}"]
    told = {
        f"{merged.identical:,} were here already, with the same numbers": merged.identical,
        f"{merged.kept:,} failed there and were left as they are here": merged.kept,
        f"{merged.running:,} are being run here and were left to that launch": merged.running,
    }
    lines += [line for line, count in told.items() if count]
    lines += _named("have other numbers here, which were kept", merged.conflicts)
    lines += _named("are not whole there and were not brought", merged.broken)
    return lines


def _named(what: str, trials: Sequence[Named]) -> list[str]:
    if not trials:
        return []
    rest = [f"  and {len(trials) - SHOWN:,} more"] if len(trials) > SHOWN else []
    names = [f"  {one.trial_key[:12]}  {one.env} {one.policy} seed {one.seed}" for one in trials]
    return [f"{len(trials):,} {what}:", *names[:SHOWN], *rest]


COMMAND = Command("merge", "bring in the trials of another database", add_arguments, run)
