"""Command ``doctor``: consistency checks of a results database, without changing it."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
from collections import Counter

from orchestrate.commands.command import Command
from orchestrate.commands.display import plain, show
from orchestrate.commands.output import say_json
from orchestrate.errors import ExitCode
from orchestrate.store.doctor import Finding, examine


def add_arguments(_: argparse.ArgumentParser) -> None:
    """Add no arguments beside ``--db`` and ``--json``."""


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print the findings; exit code 1 if results cannot be trusted."""
    findings = examine(arguments.db, trial_key)
    if arguments.json:
        say_json([dataclasses.asdict(one) for one in findings])
    else:
        show(*map(plain, _lines(findings)))
    errors = any(one.severity == "error" for one in findings)
    return ExitCode.SOME_FAILED if errors else ExitCode.DONE


def trial_key(config_json: str, seed: int) -> str:
    """Return the key of a trial as :class:`dopt.spec.trial.TrialSpec` makes it."""
    return hashlib.sha256(f'{config_json[:-1]},"seed":{seed}}}'.encode()).hexdigest()


def _lines(findings: list[Finding]) -> list[str]:
    if not findings:
        return ["Nothing is wrong."]
    counts = Counter(one.severity for one in findings)
    total = ", ".join(f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in counts.items())
    lines = [f"{one.severity}: {one.sentence}.\n  {one.advice}." for one in findings]
    return [*lines, total]


COMMAND = Command(
    "doctor",
    "check for damage, incomplete results, wrong keys and stale claims",
    add_arguments,
    run,
)
