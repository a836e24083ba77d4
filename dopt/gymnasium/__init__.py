"""Gymnasium adapters: its environments as systems, and the systems as its environments.

It needs the extra ``gymnasium``. Importing this package makes the systems known to
``gymnasium.make`` as ``dopt/Pendulum-v0`` and so on.
"""

from __future__ import annotations

from dopt.gymnasium.environment import Environment
from dopt.gymnasium.exploration import Exploration, register_systems

register_systems()

__all__ = ["Environment", "Exploration", "register_systems"]
