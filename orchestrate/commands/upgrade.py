"""Command ``upgrade``: migration of an older database to the current schema."""

from __future__ import annotations

import argparse
import dataclasses

from orchestrate.commands.command import Command
from orchestrate.commands.output import say, say_json
from orchestrate.errors import ExitCode
from orchestrate.store.migrations.upgrade import Upgrade, upgrade


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--no-backup", action="store_true", help="do not make a backup first")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Upgrade the database in one transaction, after a backup."""
    done = upgrade(arguments.db, backup=not arguments.no_backup)
    if arguments.json:
        say_json({**dataclasses.asdict(done), "changed": done.changed})
    else:
        say(_sentence(done))
    return ExitCode.DONE


def _sentence(done: Upgrade) -> str:
    if done.before == done.after:
        found = f"{done.safe_url} has schema {done.after}, the newest"
        packed = f"the curves of {done.packed:,} trials were packed"
        return f"{found}; {packed}." if done.packed else f"{found}: there is nothing to do."
    if done.before is None:
        return f"{done.safe_url} was empty and has schema {done.after} now."
    copy = f"a backup is in the file {done.backup}" if done.backup else "no backup was made"
    return f"{done.safe_url} went from schema {done.before} to {done.after}; {copy}."


COMMAND = Command("upgrade", "migrate an older database to the newest schema", add_arguments, run)
