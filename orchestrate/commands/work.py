"""Command ``work``: run registered trials on this machine, for a limited time."""

from __future__ import annotations

import argparse
import sys
from functools import partial

from orchestrate.cli_parser import length_of_time, positive, tell
from orchestrate.commands.command import Command
from orchestrate.commands.output import say_json
from orchestrate.errors import ExitCode
from orchestrate.program import say
from orchestrate.redaction import without_password
from orchestrate.store import Reader


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--until",
        type=length_of_time("--until"),
        metavar="TIME",
        help="hold nothing after this time from now, such as 55m, 1h30m or 90s (default: run until "
        "no trial is left)",
    )
    parser.add_argument(
        "--processes",
        type=positive("--processes", int),
        metavar="N",
        help="trials at once (default: one for each core that this process may use)",
    )
    number = partial(positive, number=float)
    parser.add_argument(
        "--timeout", type=number("--timeout"), default=3600.0, help="seconds that a trial may take"
    )
    parser.add_argument(
        "--memory-gib", type=number("--memory-gib"), metavar="GIB", help="memory of one process"
    )
    parser.add_argument(
        "--retry-memory",
        type=number("--retry-memory"),
        metavar="FACTOR",
        help="run a trial that exceeds --memory-gib once more, with so many times as much",
    )
    parser.add_argument(
        "--lease",
        type=number("--lease"),
        default=60.0,
        help="seconds for which a worker that is lost keeps its trials on PostgreSQL",
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    """Run trials until none is left, the time is over, or a signal comes."""
    from orchestrate.runner.run_grid import Output
    from orchestrate.runner.worker import WorkerSettings, run_worker

    Reader.open(arguments.db).close()  # a worker creates no database
    names = ("processes", "timeout", "memory_gib", "retry_memory")
    given = {name: getattr(arguments, name) for name in names}
    settings = WorkerSettings(arguments.db, arguments.until, lease=arguments.lease, **given)
    answer = _to_stderr if arguments.json else say
    code = run_worker(settings, Output(answer, _to_stderr, sys.stderr))
    if arguments.json:
        say_json({"exit_code": code.value, "complete": code in (0, ExitCode.SOME_FAILED)})
    return code


def _to_stderr(line: str) -> None:
    tell(sys.stderr, f"{without_password(line)}\n")


COMMAND = Command("work", "run registered trials on this machine", add_arguments, run)
