"""Trajectories within limits, designs, the attainable information, and the files for others."""

from __future__ import annotations

import dataclasses
import json
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from dopt.errors import SpecificationError
from dopt.robots.body import Body, Motion
from dopt.robots.design import LEAST, Design, Problem, attainable, gradient, multisine
from dopt.robots.limits import Limits
from dopt.robots.parameters import relative_errors
from dopt.robots.report import Report
from dopt.robots.sysid import sequences
from dopt.robots.trajectories import ROOM, Family, Fourier, Ladder, Multisine, Spline
from tests.dopt.robots.test_body import FOLD, arm, body_of, jaco, limits, limits_of

mujoco = pytest.importorskip("mujoco", reason="needs MuJoCo")

__all__ = ["arm", "limits"]  # fixtures


def families(limits: Limits, seconds: float) -> list[Family]:
    return [
        Multisine(limits, seconds),
        Fourier(limits, seconds, 2.0),
        Fourier(limits, seconds, 5.0),
        Ladder(limits, seconds),
    ]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("seconds", [3.0, 10.0])
def test_motions_keep_limits_begin_and_end_at_rest_and_are_integrals(
    limits: Limits, seed: int, seconds: float
) -> None:
    rng = np.random.default_rng(seed)
    tried = [(one, 2.0 * rng.standard_normal(one.size)) for one in families(limits, seconds)]
    spline, (drawn, numbers) = Spline(limits, seconds), tried[seed % len(tried)]
    points = spline.nearest(drawn.motion(numbers, 0.04))
    for radius in (0.1, 0.3):
        points = spline.ascent(points, rng.standard_normal((points.size // 4, 4)), radius)
    for family, numbers in (*tried, (spline, points)):
        motion = family.motion(numbers, 0.002)
        shares = limits.shares(motion)
        assert max(shares.values()) <= ROOM + 1e-9, (family.name, shares)
        assert np.abs(motion.velocities[[0, -1]]).max() < 1e-9, family.name
        mean = (motion.velocities[1:] + motion.velocities[:-1]) / 2.0
        moved = motion.positions[0] + np.cumsum(mean, axis=0) * motion.dt
        np.testing.assert_allclose(motion.positions[1:], moved, atol=2e-4, err_msg=family.name)
        slopes = np.diff(motion.velocities, axis=0) / motion.dt
        mean = (motion.accelerations[1:] + motion.accelerations[:-1]) / 2.0
        off = np.abs(slopes - mean) / limits.acceleration
        assert np.quantile(off, 0.9) < 0.01, family.name  # short ramps fall between two rows
        assert (np.abs(slopes) <= limits.acceleration).all(), family.name


def test_a_ladder_holds_constant_speeds(limits: Limits) -> None:
    ladder = Ladder(limits, 10.0)
    motion = ladder.motion(np.random.default_rng(0).standard_normal(ladder.size), 0.002)
    still = np.abs(motion.accelerations) < 1e-9
    fast = np.abs(motion.velocities) > 1e-9
    assert (still & fast).mean() > 0.4


def test_a_design_beats_multisines_and_no_motion_beats_the_bound(arm: Body, limits: Limits) -> None:
    problem = Problem(arm, limits, "damping,frictionloss", 6.0)
    design = Design.of(problem, effort=8)
    scores = list(map(problem.score, design.candidates))
    assert scores == sorted(scores)
    reference = multisine(problem, np.random.default_rng(5))
    assert problem.score(design.best) < problem.score(reference)
    assert all(0.0 < one.share <= 1.0 for one in design.candidates)
    assert np.log(design.best.errors / design.reference).mean() < np.log(0.9)
    # Random motions of other seeds stay below the bound, too.
    bound, gap = attainable(problem, np.random.default_rng(9))
    rng = np.random.default_rng(11)
    for family in families(limits, 6.0):
        one = problem.candidate(family, rng.standard_normal(family.size))
        assert problem.determinant(problem.information(one.motion(0.04))) < bound
    assert 0.0 <= gap < 0.5 * problem.count


def test_the_bound_of_viscous_friction_alone_is_full_speed(arm: Body, limits: Limits) -> None:
    """Each viscous constant is best known at the largest speed: the bound in closed form."""
    problem = Problem(arm, limits, "damping", 5.0, nuisance="", noise=0.01, rate=100.0)
    bound, gap = attainable(problem, np.random.default_rng(0))
    steps = np.array([one.scale for one in problem.requested])
    most = 500.0 * (steps * limits.velocity / (0.01 * limits.torque)) ** 2
    exact = float(np.log1p(most).sum())
    assert exact - 1e-6 < bound < exact + 0.3
    assert gap < 0.3


@pytest.mark.parametrize("share", [0.03, 0.003])
def test_torque_limits_shorten_motions(arm: Body, limits: Limits, share: float) -> None:
    weak = dataclasses.replace(limits, torque=limits.torque * np.array([share, 1.0, 1.0, 1.0]))
    problem = Problem(arm, weak, "mass", 6.0)
    family = Multisine(weak, 6.0)
    one = problem.candidate(family, np.random.default_rng(1).standard_normal(family.size))
    assert one.reach < 1.0
    errors = problem.errors(problem.information(one.motion(problem.step)))
    np.testing.assert_allclose(one.errors, errors)  # once of a longer motion, after many attempts
    assert not one.free or problem.strains(one.motion(0.04)).max() <= 1.0 + 1e-9


def test_viscous_friction_is_less_where_a_motion_is_slow(tmp_path: Path) -> None:
    """Once it was the one at the limit of velocity, which no torque of a weak motor overcame."""
    body = body_of(
        """<mujoco><worldbody><body><joint name="j" axis="0 0 1" range="-2 2" damping="0.01"/>
        <geom size="0.05" pos="0.1 0 0" mass="0.01"/></body></worldbody></mujoco>"""
    )
    given = "joints: {default: {velocity: 6, acceleration: 60, torque: 0.05}}"
    weak = limits_of(body, tmp_path, given)
    problem = Problem(body, weak, "damping", 5.0)
    one = multisine(problem, np.random.default_rng(0))
    fast = np.abs(one.motion(0.01).velocities).max()
    assert one.free
    assert fast < 5.0


class Dip(Family):
    """Motion that is in the floor for 20 ms, between two rows of the search."""

    name = "dip"
    size = 1

    def motion(self, numbers: np.ndarray, dt: float, reach: float = 1.0) -> Motion:  # noqa: ARG002  # one motion
        t = dt * np.arange(round(self.seconds / dt))
        positions = np.where(np.abs(t - 0.06) < 0.011, 1.2, 0.0)[:, None]
        return Motion(dt, positions, 0.0 * positions, 0.0 * positions)


def test_a_touch_between_the_rows_of_the_search_is_found_at_the_end(tmp_path: Path) -> None:
    body = body_of(FOLD)
    limits = limits_of(
        body, tmp_path, "joints: {hinge: {velocity: 2, acceleration: 9, torque: 40}}"
    )
    problem = Problem(body, limits, "mass", 3.0)
    one = problem.candidate(Dip(limits, 3.0), np.zeros(1))
    assert one.free
    assert not problem.checked(one).free
    design = Design.of(problem, effort=8)
    assert not body.collisions(design.best.motion(0.005).positions)
    touched = [body.collisions(each.motion(0.01).positions) for each in design.candidates]
    assert [each.free for each in design.candidates] == [not found for found in touched]


def test_expected_errors_are_reached_by_a_fit_to_simulated_torques() -> None:
    """Least squares on torques with the declared noise: errors as expected, over 200 draws."""
    body = jaco()
    sizes = (np.full(6, size) for size in (1.0, 5.0, 20.0))
    limits = Limits(np.tile([-1.0, 1.0], (6, 1)), *sizes)
    problem = Problem(body, limits, "damping,frictionloss", 4.0, noise=1e-5, rate=100.0)
    family = Ladder(limits, 4.0)
    one = problem.candidate(family, np.random.default_rng(2).standard_normal(family.size))
    motion = one.motion(0.01)
    rows = problem.unknowns.weighted(motion, 100.0).reshape(-1, len(problem.unknowns))
    rng = np.random.default_rng(3)
    found = np.linalg.lstsq(rows, rng.standard_normal((len(rows), 200)), rcond=None)[0]
    ratio = found.std(axis=1) / problem.errors(problem.information(motion))
    assert ratio.min() > 0.8
    assert ratio.max() < 1.2


def test_a_centre_on_the_axis_in_the_file_has_the_error_of_the_mass(tmp_path: Path) -> None:
    """Gravity tells mass times centre alone; where the file's centre is 0, the mass has no effect.

    A robot whose centre is off by a tenth of its size has a tenth of the mass's error in it.
    """
    body = body_of(
        """<mujoco><worldbody><body name="wheel"><joint name="axle" axis="0 1 0" range="-1 1"/>
        <inertial pos="0 0 0" mass="2" diaginertia="2e-4 2e-4 2e-4"/></body></worldbody></mujoco>"""
    )
    given = "joints: {axle: {velocity: 2, acceleration: 9, torque: 10}}"
    limits = limits_of(body, tmp_path, given)
    problem = Problem(body, limits, "com_x,mass", 5.0, nuisance="", noise=0.001)
    family = Fourier(limits, 5.0, 5.0)
    motion = family.motion(np.random.default_rng(0).standard_normal(family.size), 0.01)
    assert relative_errors(problem.unknowns.information(motion, 500.0))[0] < 0.01
    error, _ = problem.errors(problem.information(motion))
    assert error == pytest.approx(LEAST / np.sqrt(1.0 + LEAST**2), rel=0.02)


def test_the_best_random_motion_is_improved_the_more_the_longer(arm: Body, limits: Limits) -> None:
    lines: list[str] = []
    problem = Problem(arm, limits, "damping", 3.0)
    first, again, longer, other = (
        Design.of(problem, seed=seed, effort=effort, progress=progress)
        for seed, effort, progress in ((1, 3, lines.append), (1, 3, str), (1, 20, str), (2, 3, str))
    )
    assert first.best.name == "spline"
    assert lines[-1].startswith(f"spline, from {first.candidates[1].name}, 0.2 s")
    np.testing.assert_array_equal(first.best.numbers, again.best.numbers)
    scores = [problem.score(one.best) for one in (longer, first, other)]
    assert scores[0] < scores[1] != scores[2]


@pytest.mark.parametrize("worse", [False, True])
def test_slopes_of_splines_are_limits_of_differences(
    arm: Body, limits: Limits, worse: bool
) -> None:
    """Also of the penalty, where one error is far above its reference."""
    problem = Problem(arm, limits, "mass,damping,gear", 4.0)
    rng, spline, family = np.random.default_rng(0), Spline(limits, 4.0), Fourier(limits, 4.0, 4.0)
    motion = family.motion(rng.standard_normal(family.size), problem.step)
    points = spline.nearest(motion)
    if worse:
        problem.reference[4] = 0.2 * problem.candidate(spline, points).errors[4]
    parts = zip(
        spline.basis(problem.step), gradient(problem, spline.motion(points, 0.04)), strict=True
    )
    slopes = np.sum([of.T @ by for of, by in parts], axis=0).ravel()
    for _ in range(5):
        step = 1e-5 * rng.standard_normal(len(points))
        after, before = (problem.candidate(spline, points + way * step) for way in (1.0, -1.0))
        gained = problem.score(before) - problem.score(after)
        assert gained == pytest.approx(2.0 * slopes @ step, rel=0.02)


@pytest.mark.parametrize("name", ["seconds", "noise", "rate"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_numbers_of_problems_are_positive(
    arm: Body, limits: Limits, name: str, value: float
) -> None:
    with pytest.raises(SpecificationError, match=f"{name} of a design is .* but a number above 0"):
        Problem(arm, limits, "damping", **({"seconds": 5.0} | {name: value}))


def test_the_fit_in_the_helper_s_documentation_recovers_friction_armature_and_mass(
    tmp_path: Path,
) -> None:
    """A mass that was set once counted for nothing, and motors had the defaults of the file."""
    sysid = pytest.importorskip("mujoco.sysid", reason="needs mujoco.sysid")
    (tmp_path / "two.xml").write_text(
        """<mujoco><compiler inertiafromgeom="true"/><option timestep="0.002"/>
      <default><geom contype="0" conaffinity="0"/><motor gear="3" armature="1"
      ctrllimited="true" forcelimited="true"/></default><worldbody><body pos="0 0 1">
      <joint name="a" axis="0 1 0" damping="0.8" frictionloss="0.5" armature="0.2"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
      <body name="hand" pos="0.3 0 0"><joint name="b" axis="0 1 0" damping="0.3"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      </body></body></worldbody></mujoco>"""
    )
    body = Body.load(tmp_path / "two.xml")
    data, times = mujoco.MjData(body.model), 0.002 * np.arange(700)
    torques = np.stack([6.0 * np.sin(3.0 * times), 2.0 * np.sin(5.0 * times)], axis=1)
    q = np.zeros((700, 2))
    for k, row in enumerate(torques):
        q[k] = data.qpos
        data.qfrc_applied[:] = row
        mujoco.mj_step(body.model, data)
    columns = {"q_a": q[:, 0], "q_b": q[:, 1], "tau_a": torques[:, 0], "tau_b": torques[:, 1]}
    log = pd.DataFrame({"time": 5.0 + times, **columns})
    example = (sequences.__doc__ or "").split("mass:\n\n")[1].split("\n\n    Parameters")[0]
    names: dict[str, Any] = {"sysid": sysid, "sequences": sequences, "body": body, "log": log}
    exec(textwrap.dedent(example), names)
    fitted = {
        name: float(names["fitted"][name].value[0]) for name in ("damping", "dry", "rotor", "mass")
    }
    mass = body.model.body("hand").mass[0]
    truth = {"damping": 0.8, "dry": 0.5, "rotor": 0.2, "mass": mass}
    assert fitted == pytest.approx(truth, rel=0.02)
    pieces = sequences(body, log, seconds=0.2)
    assert [len(one.times) for one in pieces.control] == [100] * 7
    for k, state in enumerate(pieces.initial_state):
        rate = (q[100 * k] - q[100 * k - 1]) / 0.002 if k else np.zeros(2)
        atol = 3e-3 if k else 0.1  # on one side of the first row alone
        np.testing.assert_allclose(state[1:5], [*q[100 * k], *rate], atol=atol)
        np.testing.assert_array_equal(pieces.sensordata[k].data, q[100 * k : 100 * (k + 1)])
    for broken, said in (
        (log.drop(columns="q_a"), "no column 'q_a'"),
        (log.assign(tau_b=np.nan), "row 0 of the columns tau_a, tau_b of the log is .* finite"),
        (log.assign(time=log.time**2), "not evenly spaced"),
    ):
        with pytest.raises(SpecificationError, match=said):
            sequences(body, broken)


def test_what_stands_against_every_motion_is_named(tmp_path: Path) -> None:
    """A slide that its torque cannot move against friction, up or, in a second one, at all."""
    text = """<mujoco><worldbody><body><joint name="z" type="slide" axis="0 0 1" range="0 1"
        frictionloss="20"/><geom size="0.1" mass="6"/></body></worldbody></mujoco>"""
    body, level = body_of(text), body_of(text.replace("<world", '<option gravity="0 0 0"/><world'))
    limits = limits_of(body, tmp_path, "joints: {z: {velocity: 1, torque: 15}}")
    with pytest.raises(
        SpecificationError, match=r"in the best one, joint 'z' takes [0-9.]+ of 15 N\)"
    ):
        Design.of(Problem(level, limits, "damping", 3.0, nuisance=""), effort=4)
    for torque in (70.0, 94.0):  # downwards; both ways, which was once refused for no reason
        near = dataclasses.replace(limits, torque=np.array([torque]))
        best = Design.of(Problem(body, near, "damping", 3.0, nuisance=""), effort=10).best
        assert best.free
        assert (best.motion(0.01).velocities.max() < 0.01) == (torque == 70.0)
    fold = body_of(FOLD)
    given = "joints: {hinge: {position: [1.0, 1.5], velocity: 1, torque: 70}}"
    problem = Problem(fold, limits_of(fold, tmp_path, given), "damping", 3.0)
    assert problem.obstacle(multisine(problem, np.random.default_rng(0))) == (
        "the bodies world and arm touch"
    )


def test_reports_print_and_hold_what_json_can(arm: Body, limits: Limits) -> None:
    problem = Problem(arm, limits, "all", 3.0)
    seen = Report.check(problem, seed=1)
    assert json.loads(json.dumps(seen)) == seen
    assert f"{len(seen['null'])} combinations" in str(seen)
    assert all(item in str(seen) for item in seen["null"][:20])
    design = Design.of(Problem(arm, limits, "damping", 3.0), seed=1, effort=2)
    told = Report.of(design)
    assert json.loads(json.dumps(told)) == told
    assert [row["name"] for row in told["candidates"]] == [one.name for one in design.candidates]
    assert "every combination of the parameters changes the torques" in str(told)
    assert f"of the limits, {design.best.name} takes" in str(told)


def test_columns_of_a_motion_are_named_by_joint(arm: Body, limits: Limits) -> None:
    design = Design.of(Problem(arm, limits, "damping", 3.0), effort=1)
    motion = design.best.motion(0.01)
    columns = arm.columns(motion)
    assert list(columns)[:2] == ["time", f"q_{arm.joints[0]}"]
    assert {len(column) for column in columns.values()} == {300}
    taken = [columns[f"tau_{joint}"] for joint in arm.joints]
    np.testing.assert_array_equal(np.transpose(taken), arm.torques(motion))


def test_knots_come_closer_where_a_spline_cannot_follow_the_best_random_motion(
    tmp_path: Path,
) -> None:
    """Fast lines in a small range: with 0.2 s between knots it lost to Fourier series."""
    body = body_of(FOLD)
    text = "joints: {default: {position: [-0.1, 0.1], velocity: 2, acceleration: 20, torque: 90}}"
    problem = Problem(body, limits_of(body, tmp_path, text), "damping", 4.0)
    lines: list[str] = []
    design = Design.of(problem, seed=1, effort=10, progress=lines.append)
    tried = [line for line in lines if line.startswith("spline")]
    assert "0.2 s between knots" in tried[0]
    assert "0.1 s between knots" in tried[1]
    assert design.best.name == "spline"
