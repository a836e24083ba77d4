"""Commands on a results database, one file for each command.

A new command is a file with a ``COMMAND`` and a line in ``COMMANDS``.
"""

from __future__ import annotations

from orchestrate.commands import (
    backup,
    doctor,
    export,
    merge,
    prune,
    query,
    retry,
    show,
    status,
    upgrade,
    vacuum,
    work,
)
from orchestrate.commands.command import Command

COMMANDS: tuple[Command, ...] = (
    work.COMMAND,
    status.COMMAND,
    show.COMMAND,
    retry.COMMAND,
    query.COMMAND,
    export.COMMAND,
    merge.COMMAND,
    doctor.COMMAND,
    upgrade.COMMAND,
    backup.COMMAND,
    prune.COMMAND,
    vacuum.COMMAND,
)
"""In the order in which the help shows them."""
