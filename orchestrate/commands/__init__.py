"""Commands on a results database.

A new command is a :class:`~orchestrate.commands.command.Command` and a line in ``COMMANDS``.
"""

from __future__ import annotations

from orchestrate.commands import design, export, maintenance, results, status
from orchestrate.commands.command import Command

COMMANDS: tuple[Command, ...] = (
    status.WORK_COMMAND,
    status.STATUS_COMMAND,
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
