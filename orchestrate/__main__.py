"""Program ``python -m orchestrate COMMAND``: commands on a results database."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence

from dopt.errors import DoptError, unknown_name
from orchestrate.cli_parser import discard_output, tell
from orchestrate.commands import COMMANDS
from orchestrate.commands.command import PROGRAM
from orchestrate.commands.output import say
from orchestrate.errors import ExitCode
from orchestrate.redaction import without_password
from orchestrate.store import StoreUnavailableError


def main(words: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    given = sys.argv[1:] if words is None else list(words)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal with a smaller character set
    try:
        if not given or given[0] in ("-h", "--help", "help"):
            say(overview())
            return ExitCode.DONE
        return _run(given[0], given[1:])
    except StoreUnavailableError as error:
        return _refuse(error, ExitCode.INFRASTRUCTURE)
    except DoptError as error:
        return _refuse(error, ExitCode.BAD_REQUEST)
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    except BrokenPipeError:
        discard_output()
        return ExitCode.DONE


def overview() -> str:
    """Return the list of commands."""
    width = max((len(command.name) for command in COMMANDS), default=0)
    lines = [f"  {command.name:<{width}}  {command.help}" for command in COMMANDS]
    usage = f"Usage: {PROGRAM} COMMAND [--db URL] [--json] ..."
    return "\n".join([usage, "", *lines, "", f"{PROGRAM} COMMAND --help shows its options."])


def _run(name: str, words: Sequence[str]) -> int:
    commands = {command.name: command for command in COMMANDS}
    if name not in commands:
        raise unknown_name("command", name, commands)
    command = commands[name]
    return command.run(command.parser().read(words, mixed=True))


def _refuse(error: DoptError, code: ExitCode) -> ExitCode:
    tell(sys.stderr, f"error: {without_password(str(error))}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
