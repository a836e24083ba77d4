"""Entry point of a launch: ``python orchestrate/launch.py [-m] [key=value ...]``.

Hydra composes the command line in :mod:`orchestrate.config`; the rest uses plain types.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

if __package__ in (None, ""):
    # Python puts a script's own folder first; the packages are in the folder above it.
    sys.path[: not sys.flags.safe_path] = [str(Path(__file__).resolve().parents[1])]

from dopt.process import collect_rarely, end_at_interrupt, raise_at_interrupt

if __name__ == "__main__":
    end_at_interrupt()

from orchestrate.errors import ExitCode, LaunchError
from orchestrate.executors.limits import pin_threads
from orchestrate.program import UsageError, answered, run
from orchestrate.records import URL_VARIABLE


@answered
def main() -> int:
    """Run the command line and return the exit code.

    What runs a launch is imported when one is asked for: ``--help`` takes no database, no kernel.
    """
    from orchestrate.config.command_line import read_command_line
    from orchestrate.config.options import format_error

    if sys.flags.optimize:
        raise UsageError(
            "Python runs without assertions (PYTHONOPTIMIZE, -O), but Hydra reads no override "
            "without them: unset PYTHONOPTIMIZE."
        )
    if not os.environ.get(URL_VARIABLE):
        os.environ.pop(URL_VARIABLE, None)  # oc.env of the configuration takes "" as a URL
    end_at_interrupt()
    try:
        request = read_command_line()
        if request is None:
            return ExitCode.DONE
        from orchestrate.runner import start

        grid, settings = start.checked(request)
    except Exception as error:
        if getattr(error, "errno", None) or isinstance(error, MemoryError):
            raise  # the system refuses something
        raise LaunchError(format_error(error)) from error
    finally:
        raise_at_interrupt()
    return start.run(request, grid, settings)


def program() -> None:
    """Run the command line as a program of its own: ``dopt-launch``."""
    pin_threads()
    collect_rarely()
    run("orchestrate.launch")


if __name__ == "__main__":
    program()
