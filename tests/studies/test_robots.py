"""Fits of the study of robots."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from dopt.robots.body import Body
from dopt.robots.design import Problem
from dopt.robots.limits import Limits
from dopt.robots.parameters import SLOW, relative_errors
from dopt.robots.trajectories import Fourier
from studies.robots.designs import FAR, KNOWN, OFF, chance, fitted, values_of
from studies.robots.simulated import CONTROL
from tests.dopt.robots.test_body import arm, limits

pytest.importorskip("mujoco", reason="needs MuJoCo")

__all__ = ["arm", "limits"]  # fixtures


def test_values_stay_positive_and_their_derivatives_are_limits_of_differences(
    arm: Body, limits: Limits
) -> None:
    unknowns = Problem(arm, limits, "mass,com,damping,gear", 3.0).unknowns
    changes, step = np.linspace(-3.0, 3.0, len(unknowns)), 1e-6
    values, slopes = values_of(unknowns, changes)
    positive = unknowns.values > 0.0
    assert (values[positive & [one.unit != "m" for one in unknowns.parameters]] > 0.0).all()
    after, before = (values_of(unknowns, changes + way * step)[0] for way in (1.0, -1.0))
    differences = (after - before) / (2.0 * step * unknowns.scales)
    np.testing.assert_allclose(slopes, differences, rtol=1e-6)


def test_errors_of_fits_are_as_large_as_expected(arm: Body, limits: Limits) -> None:
    problem = Problem(arm, limits, "mass,com,inertia,armature,damping,gear", 3.0, nuisance="")
    rng, family = np.random.default_rng(0), Fourier(limits, 3.0, 3.0)
    motion = family.motion(rng.standard_normal(family.size), CONTROL)
    information = OFF**2 * problem.information(motion)
    shares, found = relative_errors(information), []
    for _ in range(8):
        off = OFF * rng.standard_normal(problem.count)
        unknowns, gears = problem.unknowns.at(values_of(problem.unknowns, off)[0])
        body, v = unknowns.body, motion.velocities
        friction = body.model.dof_damping[body.dofs] * v
        friction += body.model.dof_frictionloss[body.dofs] * np.tanh(v / (SLOW * limits.velocity))
        torques = (body.torques(motion) + friction) / gears
        held = np.append(torques[1:] + torques[:-1], 2.0 * torques[-1:], axis=0) / 2.0
        held += problem.unknowns.noise * limits.torque * rng.standard_normal(held.shape)
        missed = fitted(problem, np.stack([motion.positions, held], axis=1), motion) - off
        found.append((missed / (OFF * shares))[shares < KNOWN])
    assert 0.7 < np.sqrt(np.square(found).mean()) < 1.3


def test_the_chance_of_large_errors_is_a_chi_squared_tail() -> None:
    assert chance(np.diag([4.0, 1.0, 9.0])) == pytest.approx(chi2.sf(3 * FAR**2, 3), rel=0.3)
    assert chance(np.full((3, 3), 2.0)) == pytest.approx(chi2.sf(FAR**2, 1), rel=0.1)
