"""Units of what is measured, read from the labels of a system's states."""

from __future__ import annotations

import re

from dopt.systems import System


def loss_unit(system: System) -> str:
    """Return the unit of the loss: that of the learned accelerations, such as ``rad/s²``.

    Where these have several units the loss is the root of a sum over them: ``m/s², rad/s²``.
    """
    units = [_rate(_unit(system.state_labels[row])) for row in system.learned_rows]
    return ", ".join(sorted(set(units)))


def _unit(label: str) -> str:
    """Return what stands in the brackets of a label, 1 without any."""
    found = re.search(r"\[([^\]]+)\]", label)
    return found.group(1) if found else "1"


def _rate(unit: str) -> str:
    """Return a unit by second: ``rad/s`` gives ``rad/s²``."""
    return f"{unit}²" if unit.endswith("/s") else f"{unit}/s"
