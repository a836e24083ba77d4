"""Command line of a launch, up to its exit code.

What runs a launch is imported when one is asked for: ``--help`` takes no database and no kernel.
"""

from __future__ import annotations

import os
import sys

from orchestrate.config.command_line import read_command_line
from orchestrate.config.options import format_error
from orchestrate.errors import ExitCode, LaunchError
from orchestrate.program import UsageError, answered
from orchestrate.records import URL_VARIABLE


@answered
def main() -> int:
    """Run the command line and return the exit code."""
    if sys.flags.optimize:
        raise UsageError(
            "Python runs without assertions (PYTHONOPTIMIZE, -O), but Hydra reads no override "
            "without them: unset PYTHONOPTIMIZE."
        )
    if not os.environ.get(URL_VARIABLE):
        os.environ.pop(URL_VARIABLE, None)  # oc.env of the configuration takes "" as a URL
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
    return start.run(request, grid, settings)
