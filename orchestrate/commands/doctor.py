"""``doctor``: look for everything that can be wrong with a database, and change nothing."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
from collections import Counter

from orchestrate.commands.command import Command
from orchestrate.commands.display import plain, show
from orchestrate.commands.output import say_json
from orchestrate.errors import ExitCode
from orchestrate.store import Finding, examine


def add_arguments(_: argparse.ArgumentParser) -> None:
    """Take nothing beside the database."""


def run(arguments: argparse.Namespace) -> ExitCode:
    """Say what is wrong; exit code 1 where results cannot be trusted."""
    findings = examine(arguments.db, trial_key)
    if arguments.json:
        say_json([dataclasses.asdict(one) for one in findings])
    else:
        show(*map(plain, _lines(findings)))
    errors = any(one.severity == "error" for one in findings)
    return ExitCode.SOME_FAILED if errors else ExitCode.DONE


def trial_key(config_json: str, seed: int) -> str:
    """Return the key of a trial as :class:`dopt.spec.TrialSpec` makes it, from stored text."""
    return hashlib.sha256(f'{config_json[:-1]},"seed":{seed}}}'.encode()).hexdigest()


def _lines(findings: list[Finding]) -> list[str]:
    if not findings:
        return ["Nothing is wrong."]
    counts = Counter(one.severity for one in findings)
    total = ", ".join(f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in counts.items())
    lines = [f"{one.severity}: {one.sentence}.\n  {one.advice}." for one in findings]
    return [*lines, total]


COMMAND = Command("doctor", "look for damage and inconsistencies", add_arguments, run)
