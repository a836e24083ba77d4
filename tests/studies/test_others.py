"""Studies of a few tests each: long trials, coverage of intervals over seeds, robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dopt.run import run_trial
from studies.adaptive_seeds.coverage import SHAPES, coverage, resampled_coverages
from studies.speed import scaling

# What the long trials measure is the trial itself, without its evaluation


def test_the_steps_that_are_measured_are_the_trials() -> None:
    trial = scaling.Steps("cartpole", 8, 20, "sketch")
    assert trial.advance(20) > 0.0
    assert np.array_equal(trial.inputs, run_trial(trial.spec).inputs)


def test_each_tenth_has_a_row_with_the_record_so_far() -> None:
    rows = list(scaling.tenths("cartpole", 8, 20, "primal", "adam_window"))
    assert [row.size for row in rows] == list(range(1, 11))
    assert rows[-1].rows == pytest.approx(10 * rows[0].rows, rel=0.0, abs=1e-9)
    assert all(row.step_us > 0.0 and row.peak > 0.0 for row in rows)


def test_a_trial_that_diverges_is_said() -> None:
    trial = scaling.Steps("cartpole", 8, 20, "sketch")
    trial.trial.record.true_states[0] = np.inf
    with pytest.raises(RuntimeError, match="cartpole, width 8 diverged at step 0"):
        trial.advance(1)


# The interval that stops a configuration covers the geometric mean as often as it says

STUDIES = 1_000


@pytest.mark.parametrize("shape", ["normal", "skewed", "heavy tails"])
@pytest.mark.parametrize("spread", [0.1, 0.15])
def test_at_least_95_percent_of_simulated_studies_are_covered(shape: str, spread: float) -> None:
    found = coverage(SHAPES[shape], STUDIES, spread)
    assert found.value >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / STUDIES)
    assert found.seeds < 65, "it stops before all seeds are used"


def test_the_interval_covers_with_losses_as_launches_have_them() -> None:
    found = [share.value for share in resampled_coverages(100).values()]
    assert len(found) == 38
    assert np.mean(found) >= 0.95
    assert min(found) >= 0.95 - 4 * np.sqrt(0.05 * 0.95 / 100)


def test_a_fit_finds_the_parameters_of_a_robot_without_noise() -> None:
    """Within the errors that the declared noise would leave, so the fit itself is no larger one."""
    pytest.importorskip("mujoco", reason="needs MuJoCo")
    pytest.importorskip("dm_control", reason="needs dm_control")
    from dopt.robots.design import Problem
    from dopt.robots.trajectories import Fourier
    from studies.robots.designs import CONTROL, UNKNOWN, fitted, measured
    from studies.robots.simulated import Friction, SimulatedRobot, jaco

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


FOLDER = Path(__file__).parents[2] / "studies"


def test_every_study_has_a_page_that_the_list_names() -> None:
    page = (FOLDER / "README.md").read_text()
    folders = [part.parent for part in FOLDER.glob("*/__init__.py")]
    assert [one.name for one in folders if not (one / "README.md").exists()] == []
    assert [one.name for one in folders if f"({one.name}/README.md)" not in page] == []
