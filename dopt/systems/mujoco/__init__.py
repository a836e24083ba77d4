"""Models of the physics engine MuJoCo as black boxes (extra ``mujoco``)."""

from __future__ import annotations

from dopt.systems.mujoco.control_suite import (
    MuJoCoAcrobot,
    MuJoCoCartpole,
    MuJoCoPendulum,
    MuJoCoReacher,
)
from dopt.systems.mujoco.engine import MuJoCo

__all__ = ["MuJoCo", "MuJoCoAcrobot", "MuJoCoCartpole", "MuJoCoPendulum", "MuJoCoReacher"]
