"""Program ``python -m orchestrate COMMAND``: commands on a results database."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from dopt.process import end_at_interrupt

if __name__ == "__main__":
    end_at_interrupt()

from orchestrate.program import answered, check_removed, run

if __name__ == "__main__":
    run("orchestrate.__main__")  # what cannot be imported is answered, too

from dopt.errors import unknown_name
from orchestrate.commands import PROGRAM, Command, design, export, maintenance, results, say
from orchestrate.errors import ExitCode

COMMANDS: tuple[Command, ...] = (
    maintenance.WORK_COMMAND,
    maintenance.STATUS_COMMAND,
    results.SHOW_COMMAND,
    maintenance.RETRY_COMMAND,
    results.QUERY_COMMAND,
    export.EXPORT_COMMAND,
    maintenance.MERGE_COMMAND,
    maintenance.DOCTOR_COMMAND,
    maintenance.UPGRADE_COMMAND,
    maintenance.BACKUP_COMMAND,
    maintenance.PRUNE_COMMAND,
    design.DESIGN_COMMAND,
)
"""In the order in which the help shows them."""


@answered
def main(words: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    given = sys.argv[1:] if words is None else list(words)
    if not given or given[0] in ("-h", "--help", "help"):
        say(overview())
        return ExitCode.DONE
    name, *rest = given
    commands = {command.name: command for command in COMMANDS}
    if name not in commands:
        check_removed(f"orchestrate {name}")
        raise unknown_name("command", name, commands)
    return commands[name].run(commands[name].parser().read(rest, mixed=True))


def overview() -> str:
    """Return the list of commands."""
    width = max((len(command.name) for command in COMMANDS), default=0)
    lines = [f"  {command.name:<{width}}  {command.help}" for command in COMMANDS]
    usage = f"Usage: {PROGRAM} COMMAND [--db URL] [--json] ..., or {PROGRAM} --version"
    return "\n".join([usage, "", *lines, "", f"{PROGRAM} COMMAND --help shows its options."])
