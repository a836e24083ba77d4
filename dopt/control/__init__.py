"""Control with the learned model, as a measure of what exploration taught it.

A trial with a ``task`` section is assessed at some of its steps: the model learned so far plans a
control task on the true system. The true model plans the same task with the same planner.
"""

from __future__ import annotations

from dopt.control.task import Control

TASKS: dict[str, type[Control]] = {Control.name: Control}

__all__ = ["TASKS", "Control"]
