"""Command ``vacuum``: give the space of deleted rows back."""

from __future__ import annotations

import argparse
import dataclasses

from orchestrate.commands.command import Command
from orchestrate.commands.output import say, say_json
from orchestrate.errors import ExitCode
from orchestrate.store.vacuum import vacuum


def add_arguments(_: argparse.ArgumentParser) -> None:
    """Add no arguments beside ``--db`` and ``--json``."""


def run(arguments: argparse.Namespace) -> ExitCode:
    """Vacuum the database and print its size before and after."""
    done = vacuum(arguments.db)
    if arguments.json:
        say_json(dataclasses.asdict(done))
    else:
        say(f"{done.safe_url}: {done.before:,} bytes before, {done.after:,} bytes now")
    return ExitCode.DONE


COMMAND = Command("vacuum", "give the space of deleted rows back", add_arguments, run)
