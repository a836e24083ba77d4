"""Logs of a robot in the form that ``mujoco.sysid``, the fits of MuJoCo, reads."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from dopt.arguments import check_finite, within
from dopt.errors import SpecificationError
from dopt.robots.body import Body, specification
from dopt.types import Array

if TYPE_CHECKING:
    import mujoco.sysid

NEAR = 5
"""Rows on each side of the first one of a piece by which its velocities are estimated."""


def sequences(
    body: Body, log: Any, name: str = "log", seconds: float = 1.0
) -> mujoco.sysid.ModelSequences:
    """Return a log with the specification of its robot, for ``mujoco.sysid.optimize``.

    The specification has a motor, which applies the torque, and a sensor of position for each
    driven joint, in place of its own actuators and sensors, and an explicit mass for each body.
    A fit of friction, armature and a mass:

        parameters = sysid.ParameterDict()
        for name, nominal, change in (
            ("damping", 0.5, lambda spec, one: spec.joint("a").damping.put(0, one.value)),
            ("dry", 0.3, lambda spec, one: setattr(spec.joint("a"), "frictionloss", one.value[0])),
            ("rotor", 0.1, lambda spec, one: setattr(spec.joint("a"), "armature", one.value[0])),
            ("mass", 1.0, lambda spec, one: setattr(spec.body("hand"), "mass", one.value[0])),
        ):
            parameters.add(sysid.Parameter(name, nominal, 0.01, 9.0, modifier=change))
        residual = sysid.build_residual_fn(models_sequences=[sequences(body, log)])
        fitted, _ = sysid.optimize(initial_params=parameters, residual_fn=residual)

    Parameters
    ----------
    body : Body
        A robot that was read from a file.
    log : DataFrame or mapping
        Columns ``time`` [s], evenly spaced, and ``q_JOINT`` [rad] and ``tau_JOINT`` [N m] of each
        driven joint, as ``orchestrate design --out`` names them. A torque acts from its row to the
        next.
    name : str
        Name of the sequences.
    seconds : float
        Length of the pieces into which the log is cut. Each is simulated from a state of its own:
        in a long one, errors of measured torques add up to errors of positions.

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
    count = max(1, round(len(times) * dt / within("seconds of a piece", seconds, math.inf)))
    parts = np.array_split(np.arange(len(times)), min(count, len(times) // 2))
    # A rollout stamps what a sensor reads at the beginning of a step with the time of its end.
    return sysid.ModelSequences(
        name,
        spec,
        [f"{name}_{i}" for i in range(len(parts))],
        [_state(body, model, times, positions, part[0]) for part in parts],
        [
            sysid.TimeSeries.from_control_names(times[part] - times[part[0]], torques[part], model)
            for part in parts
        ],
        [
            sysid.TimeSeries.from_names(times[part] - times[part[0]] + dt, positions[part], model)
            for part in parts
        ],
    )


def _column(log: Any, names: list[str]) -> Array:
    missing = [one for one in names if one not in log]
    if missing:
        raise SpecificationError(
            f"a log has no column '{missing[0]}', but the columns time, q_JOINT and tau_JOINT of "
            f"each driven joint are expected: rename its columns."
        )
    values = np.column_stack([np.asarray(log[one], dtype=float) for one in names])
    check_finite(f"columns {', '.join(names[:3])} of the log", values)
    return values


def _measured(body: Body, dt: float) -> Any:
    """Return the specification of a robot with a motor and a sensor for each driven joint."""
    import mujoco

    if body.source is None:
        raise SpecificationError(
            "the robot was not read from a file, but mujoco.sysid needs its specification: read "
            "it by Body.load()."
        )
    spec, *_ = specification(body.source)
    for part in [*spec.keys, *spec.actuators, *spec.sensors]:
        spec.delete(part)
    spec.option.timestep = dt
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    for part in spec.bodies[1:]:  # of geoms, a mass that is set would count for nothing
        part.explicitinertial, part.fullinertia = True, np.full((6, 1), np.nan)
        for kind in ("mass", "inertia", "ipos", "iquat"):
            setattr(part, kind, getattr(body.model, f"body_{kind}")[part.id])
        # What :class:`Body` moved to the joints, from flags and actuators.
        if body.model.jnt_actgravcomp.any():
            part.gravcomp = 0.0
    for part in spec.joints:
        part.name = part.name or f"joint{part.id}"
    empty = mujoco.MjSpec()
    plain = empty.add_actuator()
    for joint, dof in zip(body.joints, body.dofs, strict=True):
        part, linear = spec.joint(joint), body.model.dof_damping[dof]
        part.armature = body.model.dof_armature[dof]
        part.damping = [linear, *part.damping[1:]] if np.ndim(part.damping) else linear
        motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.ctrllimited = motor.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
        for kind in ("gear", "armature", "damping"):  # else the defaults of the file
            if hasattr(plain, kind):
                setattr(motor, kind, getattr(plain, kind))
        spec.add_sensor(
            name=f"{joint}_position",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
    return spec


def _state(body: Body, model: Any, times: Array, positions: Array, row: int) -> Array:
    """Return the state at a row, by a parabola through the rows about it.

    The engine moves by the velocity after each step: it begins with the one half a step before.
    """
    from mujoco import sysid

    near = slice(max(0, row - NEAR), row + NEAR + 1)
    t = times[near] - times[row]
    fit = np.polyfit(t, positions[near], min(2, len(t) - 1))
    bent = fit[-3] if len(fit) > 2 else 0.0
    qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
    qpos[body.addresses] = fit[-1]
    qvel[body.dofs] = fit[-2] - bent * model.opt.timestep
    return np.asarray(sysid.create_initial_state(model, qpos, qvel))
