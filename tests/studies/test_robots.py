"""The study of robots: a fit to the motion of a simulated one."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs MuJoCo")
pytest.importorskip("dm_control", reason="needs dm_control")

from dopt.robots.design import Problem
from dopt.robots.trajectories import Fourier
from studies.robots.designs import CONTROL, UNKNOWN, fitted, measured
from studies.robots.simulated import Friction, SimulatedRobot, jaco


def test_a_fit_finds_the_parameters_of_a_robot_without_noise() -> None:
    """Within the errors that the declared noise would leave, so the fit itself is no larger one."""
    body, limits = jaco()
    problem = Problem(body, limits, UNKNOWN, 8.0, nuisance="")
    family = Fourier(limits, 8.0, 5.0)
    rng = np.random.default_rng(1)
    one = problem.candidate(family, rng.standard_normal(family.size))
    off = np.abs(0.05 * rng.standard_normal(problem.count))
    values = problem.unknowns.values + off * problem.unknowns.scales
    unknowns, gears = problem.unknowns.at(values)
    true = unknowns.body
    dry, damping = true.model.dof_frictionloss[true.dofs], true.model.dof_damping[true.dofs]
    flat = np.ones(body.n)
    friction = Friction(dry, damping, 0.0 * flat, flat, 0.01 * limits.velocity)
    robot = SimulatedRobot(true, limits, 0, friction, noise=0.0, ripple=0.0, counts=0)
    motion = one.motion(CONTROL)
    found = fitted(problem, measured(robot, body, gears, motion), motion)
    sure = one.errors < 0.3
    assert sure.sum() > 8
    assert np.sqrt((((found - off) / one.errors)[sure] ** 2).mean()) < 1.0
