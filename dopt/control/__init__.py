"""Control with the learned model, as a measure of what exploration taught it.

A trial with a ``task`` section is assessed at some of its steps: the model learned so far plans a
control task on the true system. The true model plans the same task with the same planner.
"""

from __future__ import annotations

from collections.abc import Mapping

from dopt.control.task import Control
from dopt.errors import SpecificationError
from dopt.registry import build, is_none

TASKS: dict[str, type[Control]] = {Control.name: Control}


def task_from(section: object) -> Control | None:
    """Return the task that a configuration section describes; None without one, or for "none"."""
    if section is None:
        return None
    if not isinstance(section, Mapping):
        raise SpecificationError(
            f"configuration key 'task' is {section!r}, but a section with a name and fields is "
            f"expected: choose task=control, or task=none."
        )
    return None if is_none("task", section) else build("task", TASKS, section)


__all__ = ["TASKS", "Control", "task_from"]
