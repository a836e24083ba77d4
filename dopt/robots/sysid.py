"""Logs of a robot in the form that ``mujoco.sysid``, the fits of MuJoCo, reads."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dopt.errors import SpecificationError
from dopt.robots.body import Body, without_meshes
from dopt.types import Array

if TYPE_CHECKING:
    import mujoco.sysid


def sequences(body: Body, log: Any, name: str = "log") -> mujoco.sysid.ModelSequences:
    """Return a log with the specification of its robot, for ``mujoco.sysid.optimize``.

    The specification has a motor, which applies the torque, and a sensor of position for each
    driven joint, in place of its own actuators and sensors.

    Parameters
    ----------
    body : Body
        A robot that was read from a file.
    log : DataFrame or mapping
        Columns ``time`` [s], evenly spaced, and ``q_JOINT`` [rad] and ``tau_JOINT`` [N m] of each
        driven joint, as ``orchestrate design --out`` names them. A torque acts from its row to the
        next.
    name : str
        Name of the sequence.

    Raises
    ------
    SpecificationError
        If a column is missing, a number is not finite, or the times are not even.
    """
    from mujoco import sysid

    times = _column(log, ["time"])[:, 0]
    steps = np.diff(times)
    if len(times) < 2 or np.ptp(steps) > 0.01 * steps.mean() or steps.mean() <= 0.0:
        raise SpecificationError(
            "the times of a log are not evenly spaced, but at least two rows with one step between "
            "them are expected: resample it."
        )
    positions = _column(log, [f"q_{joint}" for joint in body.joints])
    torques = _column(log, [f"tau_{joint}" for joint in body.joints])
    dt = float(steps.mean())
    spec = _measured(body, dt)
    model = spec.compile()
    state = _first_state(body, model, times, positions)
    # A rollout stamps what a sensor reads at the beginning of a step with the time of its end.
    return sysid.ModelSequences(
        name,
        spec,
        name,
        state,
        sysid.TimeSeries.from_control_names(times - times[0], torques, model),
        sysid.TimeSeries.from_names(times - times[0] + dt, positions, model),
    )


def _column(log: Any, names: list[str]) -> Array:
    missing = [one for one in names if one not in log]
    if missing:
        raise SpecificationError(
            f"a log has no column '{missing[0]}', but the columns time, q_JOINT and tau_JOINT of "
            f"each driven joint are expected: rename its columns."
        )
    values = np.column_stack([np.asarray(log[one], dtype=float) for one in names])
    if not np.isfinite(values).all():
        raise SpecificationError(
            f"the columns {', '.join(names[:3])} of a log hold a number that is not finite, but "
            f"none is expected: leave such rows out at its ends, or fill them."
        )
    return values


def _measured(body: Body, dt: float) -> Any:
    """Return the specification of a robot with a motor and a sensor for each driven joint."""
    import mujoco

    if body.source is None:
        raise SpecificationError(
            "the robot was not read from a file, but mujoco.sysid needs its specification: read "
            "it by Body.load()."
        )
    try:
        spec = mujoco.MjSpec.from_file(str(body.source))
        spec.compile()
    except ValueError:
        spec = without_meshes(body.source)
    for part in [*spec.keys, *spec.actuators, *spec.sensors]:
        spec.delete(part)
    spec.option.timestep = dt
    # What :class:`Body` moved to the joints, from flags and actuators.
    if body.model.jnt_actgravcomp.any():
        for part in spec.bodies:
            part.gravcomp = 0.0
    for part in spec.joints:
        part.name = part.name or f"joint{part.id}"
    for joint, dof in zip(body.joints, body.dofs, strict=True):
        part, linear = spec.joint(joint), body.model.dof_damping[dof]
        part.armature = body.model.dof_armature[dof]
        part.damping = [linear, *part.damping[1:]] if np.ndim(part.damping) else linear
        motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        spec.add_sensor(
            name=f"{joint}_position",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
    return spec


def _first_state(body: Body, model: Any, times: Array, positions: Array) -> Array:
    """Return the state at the first row; velocities by a parabola through the first rows."""
    from mujoco import sysid

    rows = min(5, len(times))
    qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
    qpos[body.addresses] = positions[0]
    fit = np.polyfit(times[:rows] - times[0], positions[:rows], min(2, rows - 1))
    qvel[body.dofs] = fit[-2]
    result: Array = sysid.create_initial_state(model, qpos, qvel)
    return result
