"""Explorer of robots with a known body: limits, stops, payloads, and bad measurements."""

import dataclasses
import itertools
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from dopt.errors import ExplorationError, SpecificationError
from dopt.robots.body import Body, hang, point
from dopt.robots.explorer import LOST, RobotExplorer
from dopt.robots.friction import SPEEDS
from dopt.robots.limits import Limits
from dopt.robots.tracking import Guard
from studies.robots.online import LOOK, Trace, explore, true_values
from studies.robots.simulated import Friction, SimulatedRobot, jaco
from tests.dopt.robots.test_body import body_of, limits_of

Arm = Callable[[], tuple[Body, Limits]]

ARM = """
<mujoco>
  <worldbody>
    <body>
      <joint name="turn" axis="0 0 1" armature="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.04" mass="2"/>
      <body pos="0 0 0.2">
        <joint name="lift" axis="0 1 0" armature="0.1"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1.5"/>
        <body pos="0.3 0 0">
          <joint name="bend" axis="0 1 0" armature="0.05"/>
          <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.03" mass="1"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


TWO_LINKS = """
<mujoco><worldbody><body><joint name="shoulder" axis="{}" armature="0.1"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.04" mass="2" contype="0" conaffinity="0"/>
  <body pos="0.4 0 0"><joint name="elbow" axis="0 1 0" armature="0.05"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1" contype="0" conaffinity="0"/>
</body></body></worldbody></mujoco>
"""


def small() -> tuple[Body, Limits]:
    return Body(mujoco.MjModel.from_xml_string(ARM)), Limits(
        position=np.array([[-2.8, 2.8], [-1.5, 1.5], [-2.0, 2.0]]),
        velocity=np.array([2.0, 2.0, 3.0]),
        acceleration=np.full(3, 10.0),
        torque=np.array([40.0, 60.0, 25.0]),
    )


WALLS = """<worldbody>
    <geom type="plane" pos="0 0 -0.05" size="1 1 1"/>
    <geom type="plane" pos="0 0.25 0" zaxis="0 -1 0" size="1 1 1"/>
"""


def walled() -> tuple[Body, Limits]:
    """Return the arm beside a wall and above a floor, both within its joints' limits."""
    text = ARM.replace("<worldbody>", WALLS)
    return Body(mujoco.MjModel.from_xml_string(text)), small()[1]


def pair(
    seed: int, arm: Arm = small, payload: tuple[float, float] | None = None, **given: Any
) -> tuple[SimulatedRobot, RobotExplorer]:
    """Return a robot and its explorer."""
    body, limits = arm()
    robot = SimulatedRobot(body, limits, seed, payload=payload)
    return robot, RobotExplorer(body, limits, seed=seed, **given)


def positions_of(robot: SimulatedRobot, explorer: RobotExplorer, seconds: float) -> np.ndarray:
    """Return the true positions of a run, (T, n)."""
    found, q = [], robot.state()[0]
    for _ in range(round(seconds / explorer.dt)):
        torque = explorer.ask(q)
        robot.step(torque)
        q = robot.state()[0]
        explorer.tell(q, torque)
        found.append(robot.q)
    return np.array(found)


def check_shares(trace: Trace, position: float = 1.0, velocity: float = 1.03) -> None:
    """Check that positions, velocities and torques were within so large shares of their limits."""
    assert trace.shares["position"] < position
    assert trace.shares["velocity"] < velocity
    assert trace.shares["torque"] <= 1.0


@pytest.mark.parametrize("arm", [small, jaco])
@pytest.mark.parametrize("seed", [0, 1])
def test_limits_are_kept_and_friction_is_learned(arm: Arm, seed: int) -> None:
    robot, explorer = pair(seed, arm)
    trace = explore(robot, explorer, 3.0)
    check_shares(trace)
    assert np.median(trace.errors[-1]) < 0.1
    assert explorer.counts["changed"] == 0
    assert explorer.counts["windows"] == explorer.steps // explorer.learner.window.size


LIGHT = """<mujoco><worldbody>
  <body name="x"><joint name="x" type="slide" axis="1 0 0" range="-.6 .6"/>
    <geom type="box" size=".1 .4 .05" mass="12"/>
    <body pos="0 0 .2"><joint name="turn" axis="0 0 1" range="-170 170" armature="0.3"/>
      <geom type="box" size=".3 .03 .03" pos=".3 0 0" mass="3"/>
      <body pos=".65 0 0"><joint name="roll" axis="1 0 0" range="-170 170"/>
        <geom type="box" size=".02 .05 .02" mass=".3"/></body></body></body>
</worldbody></mujoco>"""


def loose() -> tuple[Body, Limits]:
    """Return a robot whose last joint is light, for its torque, and without armature."""
    return Body(mujoco.MjModel.from_xml_string(LIGHT)), Limits(
        position=np.array([[-0.6, 0.6], [-2.9, 2.9], [-2.9, 2.9]]),
        velocity=np.array([1.0, 2.0, 3.0]),
        acceleration=np.array([5.0, 8.0, 20.0]),
        torque=np.array([120.0, 40.0, 1.0]),
    )


@pytest.mark.parametrize("seed", [3, 4, 7])
def test_joints_that_are_light_for_their_friction_keep_their_limits(seed: int) -> None:
    """Once they took 2.5, 1.4 and 2.1 times their limits of velocity, where they broke loose."""
    body, limits = loose()
    random = np.random.default_rng(seed)
    coulomb, size = random.uniform(0.05, 0.3, 3), limits.torque
    friction = Friction(
        coulomb * size,
        random.uniform(0.01, 0.1, 3) * size / limits.velocity,
        random.uniform(0.0, 0.4, 3) * coulomb * size,
        random.uniform(0.01, 0.06, 3) * limits.velocity,
        0.002 * limits.velocity,
    )
    robot = SimulatedRobot(body, limits, seed, friction=friction)
    explorer = RobotExplorer(body, limits, seed=seed)
    check_shares(explore(robot, explorer, 1.5), velocity=1.0)


ONE = """<mujoco><worldbody><body pos="0 0 1"><joint name="one" {joint}/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size="0.02" mass="1"/>
  <geom size=".05" pos="0 0 -.4" mass="{load}"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "joint",
    [
        'axis="0 1 0" range="-150 150"',
        'type="slide" axis="0 0 1" range="-.5 .5"',
        'type="slide" axis="1 0 0" range="-.5 .5"',
    ],
)
def test_single_joints_without_armature_keep_their_limits(joint: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    body = body_of(ONE.format(joint=joint, load=random.uniform(0.1, 2.0)))
    torque, rate = random.uniform(50.0, 150.0), random.uniform(0.5, 3.0)
    limits = Limits(body.ranges, *np.array([[rate], [4.0 * rate], [torque]]))
    dry, viscous = random.uniform(0.03, 0.3) * torque, random.uniform(0.01, 0.1) * torque / rate
    friction = Friction(*np.array([[dry], [viscous], [0.3 * dry], [0.03 * rate], [0.002 * rate]]))
    robot = SimulatedRobot(body, limits, seed, friction)
    check_shares(explore(robot, RobotExplorer(body, limits, seed=seed), 1.5), velocity=1.0)


@pytest.mark.parametrize("torque", [20.0, 5.0])
def test_joints_without_armature_are_named(torque: float) -> None:
    """Once nothing was said of those that are slow at first, like the last one of a sawyer."""
    body, limits = loose()
    explorer = RobotExplorer(
        body, dataclasses.replace(limits, torque=np.array([120.0, 40.0, torque]))
    )
    explorer.ask(np.zeros(3))
    assert "limit of velocity: give the armature" in explorer.warnings[0]
    assert "turns roll so fast that references begin with 10 %" in explorer.warnings[0]


def wrist(inertia: float, coulomb: float) -> tuple[SimulatedRobot, RobotExplorer]:
    """Return a joint without armature, and a frame without mass on it."""
    body = body_of(
        f"""<mujoco><worldbody><body><joint name="roll" axis="0 0 1"/>
        <inertial pos="0 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/>
        <body pos="0 0 .1"><site/></body></body></worldbody></mujoco>"""
    )
    limits = Limits(np.array([[-6.0, 6.0]]), *np.array([[3.0], [15.0], [28.0]]))
    friction = Friction(*np.array([[coulomb], [0.3], [0.0], [1.0], [0.006]]))
    return SimulatedRobot(body, limits, 0, friction), RobotExplorer(body, limits)


def test_a_joint_that_runs_ahead_forgets_the_error_that_pushed_it() -> None:
    """Not until a fifth of the limit ahead, once: a ur5e's wrist broke loose to 103 %."""
    _, explorer = wrist(0.0033, 8.2)
    explorer.ask(np.zeros(1))
    for ahead, kept in ((-0.3, 1.0), (0.02, 1.0), (0.11, 0.5), (0.2, 0.0), (0.5, 0.0)):
        for error, left in ((0.4, 0.4 * kept), (-0.4, -0.4)):  # one that brakes it is kept
            explorer._v, explorer._tracker.v = np.ones(1), np.ones(1) + 3.0 * ahead
            explorer._q = explorer._tracker.q + error
            explorer._pace()
            assert explorer._q - explorer._tracker.q == pytest.approx(left)


def test_joints_that_never_move_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dopt.robots.explorer.STILL", 1.0)
    robot, explorer = wrist(1e-3, 20.0)
    explore(robot, explorer, 2.0)
    assert explorer.warnings[-1].startswith("roll did not move fast enough to learn from in 1 s")


def test_a_frame_without_mass_can_be_the_last_body() -> None:
    known = wrist(0.0033, 1.0)[1].known
    hang(known.model, 2, point(0.0, np.ones(3), 1.0))  # once that made torques NaN
    np.testing.assert_allclose(known.inverse(*np.zeros((2, 1)), np.ones(1)), 0.0033)
    centre = np.array([0.1, 0.0, 0.0])
    for mass, moment in ((0.5, 0.5 * centre), (-0.49997, 0.003 - 0.5 * centre)):
        hang(known.model, 2, point(mass, moment))  # what is left once had 0.6 kg m²
    assert known.inverse(*np.zeros((2, 1)), np.ones(1)) < 0.005


def test_references_keep_their_limits_exactly() -> None:
    robot, explorer = pair(5)
    for _ in range(1500):
        positions_of(robot, explorer, explorer.dt)
        assert (np.abs(explorer._a) <= robot.limits.acceleration).all()
        assert (np.abs(explorer._v) <= robot.limits.velocity).all()


@pytest.mark.parametrize(("inputs", "seeds"), [("references", 4), ("torques", 1)])
def test_bodies_do_not_touch_what_they_do_not_touch_at_home(inputs: str, seeds: int) -> None:
    near = 0
    for seed in range(seeds):
        robot, explorer = pair(seed, walled, inputs=inputs)
        went = positions_of(robot, explorer, 2.0)
        assert not robot.body.collisions(went)
        assert np.ptp(went[-500:], axis=0).max() > 0.1  # it does not stay before the wall
        near += explorer.counts["near"]
    assert near >= seeds / 2
    blind = pair(0, inputs=inputs)
    assert robot.body.collisions(positions_of(*blind, 1.0))
    assert blind[1].counts["near"] == 0


def test_geoms_that_cannot_collide_are_not_looked_at() -> None:
    text = ARM.replace("<geom", '<geom contype="0" conaffinity="0"')
    limits = small()[1]
    assert Guard(small()[0], limits, limits.acceleration).needed
    guard = Guard(Body(mujoco.MjModel.from_xml_string(text)), limits, limits.acceleration)
    assert not guard.needed
    assert guard.free(np.zeros(3), limits.velocity, np.zeros(3))


def test_a_joint_that_moves_two_near_bodies_together_is_free(tmp_path: Path) -> None:
    """Their distance changes by rounding alone, which once kept a robot in its place for ever."""
    body = body_of(
        """<mujoco><worldbody><body><joint name="turn" axis="0.3 0.2 1" range="-170 170"/>
        <geom size="0.01" contype="0" conaffinity="0"/>
        <body pos="0.2 0.1 0"><joint name="a" type="slide" axis="1 0.5 0" range="-0.2 0.2"/>
        <geom size="0.07"/></body>
        <body pos="0.1 0.3 0.1"><joint name="b" type="slide" axis="0 1 0" range="-0.2 0.2"/>
        <geom size="0.07"/></body></body></worldbody></mujoco>"""
    )
    limits = limits_of(body, tmp_path, "joints: {default: {velocity: 1, torque: 50}}")
    guard, v = Guard(body, limits, np.ones(3)), np.array([0.1, 0.0, 0.0])
    near = np.array([0.0, 0.0, -0.18])
    assert -0.01 < guard._contacts.room(near) < 0.0
    for turn in np.linspace(-2.5, 2.5, 200):
        now = near + np.array([turn, 0.0, 0.0])
        assert guard.free(now + 0.002 * v, v, now)
        assert guard.open(now, 0) == (True, True)
    assert not guard.free(near, np.array([0.0, 0.0, -0.1]), near)


def test_friction_is_learned_beside_a_wall() -> None:
    robot, explorer = pair(2, walled)
    trace = explore(robot, explorer, 5.0)
    assert explorer.counts["near"] > 0
    assert trace.errors[-1].max() < 0.1
    check_shares(trace)


def test_a_robot_that_begins_too_near_a_wall_leaves_it() -> None:
    robot, explorer = pair(0, walled)
    turned = np.array([np.arcsin((0.25 - 0.034) / 0.55), 0.0, 0.0])  # 4 mm from the wall
    robot.place(turned)
    went = positions_of(robot, explorer, 2.0)
    assert not robot.body.collisions(went)
    assert went[:, 0].min() < turned[0] - 0.1


def test_it_stops_when_every_interval_is_as_narrow_as_asked_for() -> None:
    robot, explorer = pair(2, stop={"curve": 0.15, "viscous": 0.3})
    limits = robot.limits
    explore(robot, explorer, 12.0, until_done=True)
    assert explorer.done
    values, half = explorer.learner.intervals()
    assert (half[:, :-2].max(axis=1) <= 0.15 * explorer.learner.sizes()).all()
    assert (np.abs(values - true_values(robot)) <= half).mean() > 0.9
    for joint, velocity in enumerate(limits.velocity):
        mean, low, high = explorer.curve(joint, SPEEDS * velocity)
        np.testing.assert_allclose(mean, values[joint, :-2] * limits.torque[joint])
        np.testing.assert_allclose(high - low, 2 * half[joint, :-2] * limits.torque[joint])
    before = explorer.report()["seconds"]
    trace = explore(robot, explorer, 1.0)
    assert np.abs(robot.v / limits.velocity).max() < 0.02
    assert len(trace.times) == 500 // LOOK
    report = explorer.report()
    assert report["seconds"] == pytest.approx(before + 1.0)
    assert "np.float64" not in str(report), "it is printed"


def test_a_payload_is_noticed_said_once_and_weighed() -> None:
    robot, explorer = pair(1, payload=(4.0, 0.8))
    body = robot.body
    own = explorer.known.model.body_mass[body.moved[-1]]
    explore(robot, explorer, 3.9)
    assert explorer.counts["changed"] == 0
    explore(robot, explorer, 4.0)
    assert explorer.counts["changed"] == 1
    assert "payload" in explorer.warnings[0]
    assert explorer.known.model.body_mass[body.moved[-1]] - own == pytest.approx(0.8, abs=0.15)
    assert body.model.body_mass[body.moved[-1]] == own


def test_a_payload_that_is_put_down_soon_is_noticed_too() -> None:
    """Once friction had learned of it by the time that changes were looked for again."""
    for seed in range(2):
        robot, explorer = pair(seed, jaco, payload=(6.0, 0.5))
        body, last = robot.body, robot.body.moved[-1]
        explore(robot, explorer, 12.0)
        assert explorer.counts["changed"] == 1
        hang(robot._model, last, -robot.ball(0.5))
        explore(robot, explorer, 6.0)
        assert explorer.counts["changed"] == 2
        left = explorer.known.model.body_mass[last] - body.model.body_mass[last]
        assert left == pytest.approx(0.0, abs=0.1)


def test_standard_errors_of_payloads_hold() -> None:
    """Once they were half of the errors: friction had learned of the payload before it was noticed.

    Torques by references in place of motions, and the inertia that was left out, added to that.
    """
    errors = []
    for seed in range(6):
        robot, explorer = pair(seed, payload=(4.0, 0.8))
        explore(robot, explorer, 6.5)
        assert explorer.payload is not None
        found, covariance = explorer.payload
        errors.append((found - robot.ball(0.8)[:4]) / np.sqrt(np.diag(covariance)))
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.6


@pytest.mark.parametrize(("axis", "hardly"), [("0 0 1", True), ("0 1 0", False)])
def test_a_mass_that_no_torque_of_gravity_tells_apart_is_said_to_be_unsure(
    axis: str, hardly: bool
) -> None:
    """Once it was a third of its value off, or negative, and no error was said.

    About an upright axis only accelerations tell it, which the noise of torques also makes.
    """
    text = TWO_LINKS.format(axis)

    def arm() -> tuple[Body, Limits]:
        half = small()[1]
        parts = (half.position, half.velocity, half.acceleration, half.torque)
        kept = [part[[1, 2]] for part in parts]
        return Body(mujoco.MjModel.from_xml_string(text)), Limits(*kept)

    robot, explorer = pair(2, arm, payload=(4.0, 0.5))
    explore(robot, explorer, 8.0)
    said = explorer.warnings[1]
    mass, error = (float(part) for part in re.findall(r"([-+.0-9]+) kg(?: more|[,)])", said)[:2])
    assert abs(mass - 0.5) < 3.0 * error
    assert ("hardly tell" in said) == hardly


@pytest.mark.parametrize("friction", ["coulomb_viscous", "network"])
def test_torques_stay_on_the_ball_or_brake(friction: str) -> None:
    robot, explorer = pair(3, inputs="torques", friction=friction, gamma=0.2)
    check_shares(explore(robot, explorer, 1.5), 1.02, 1.1)
    assert explorer.counts["plans"] == 0


def test_the_step_of_torques_is_the_best_on_the_ball() -> None:
    body, limits = small()
    explorer = RobotExplorer(body, limits, inputs="torques", friction="network", gamma=0.3)
    explorer.ask(np.zeros(3))
    learner, tracker, p = explorer.learner, explorer._tracker, explorer.learner.p
    tracker.v[:] = [0.2, -0.1, 0.3]
    explorer._torques()
    bias = explorer.known.inverse(tracker.q, tracker.v, np.zeros(3))
    mass = explorer.known.mass_matrix()
    inverse = np.linalg.inv(mass)

    def gain(u: np.ndarray) -> float:
        idle = inverse @ (-bias - learner.torques(tracker.v))
        x = (tracker.v + explorer.dt * idle) / limits.velocity
        J = learner.model.jacobian(learner.mean[:, :p], x[:, None])[:, 0]
        near = learner.model.jacobian(learner.mean[:, :p], x[:, None] + [-1e-5, 1e-5])
        bent = (near[:, 1] - near[:, 0]) / 2e-5
        moved = explorer.dt * inverse @ u / limits.velocity
        rows = J + bent * moved[:, None]
        return float(np.einsum("np,npq,nq->", rows, learner.covariance[:, :p, :p], rows))

    chosen = mass @ explorer._a + bias + learner.torques(tracker.v)
    assert np.linalg.norm(chosen / limits.torque) == pytest.approx(0.3)
    random = np.random.default_rng(0).standard_normal((3, 500))
    others = 0.3 * random / np.linalg.norm(random, axis=0) * limits.torque[:, None]
    assert gain(chosen) >= max(gain(u) for u in others.T) - 1e-12


@pytest.mark.parametrize("bad", [np.nan, 1.0])
def test_bad_measurements_are_counted_and_the_robot_brakes(bad: float) -> None:
    robot, explorer = pair(4)
    explore(robot, explorer, 1.0)
    speed = np.abs(explorer._v).sum()
    for _ in range(40):
        torque = explorer.ask(robot.state()[0] + [0.0, bad, 0.0])
        assert np.isfinite(torque).all()
        robot.step(torque)
        explorer.tell(robot.state()[0] + [0.0, bad, 0.0], torque)
    assert explorer.counts["bad"] == 40
    assert np.abs(explorer._v).sum() < speed
    check_shares(explore(robot, explorer, 1.0))
    assert explorer.counts["bad"] == 40


def test_a_clock_that_is_slow_leaves_joints_braking_within_their_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ticks, slow = itertools.count(), 0.0
    now = SimpleNamespace(perf_counter=lambda: slow * next(ticks))
    monkeypatch.setattr("dopt.robots.explorer.clock", now)
    robot, explorer = pair(6, deadline=5e-4)
    explore(robot, explorer, 1.0)
    assert explorer.counts["late"] == 0
    plans, slow = explorer.counts["plans"], 1e-3  # of a second, a call
    trace = explore(robot, explorer, 3.0)
    assert explorer.counts["plans"] == plans
    assert explorer.counts["late"] > 100
    np.testing.assert_array_equal(explorer._v, 0.0)
    assert np.abs(robot.v / robot.limits.velocity).max() < 0.02
    check_shares(trace)
    slow = 0.0
    check_shares(explore(robot, explorer, 1.0))
    assert explorer.counts["plans"] > plans


def test_an_encoder_that_stays_displaced_is_believed_after_a_while() -> None:
    robot, explorer = pair(7)
    explore(robot, explorer, 1.0)
    bad, windows, moved = [], explorer.counts["windows"], np.array([0.0, 0.3, 0.0])
    for _ in range(500):
        torque = explorer.ask(robot.state()[0] + moved)
        robot.step(torque)
        explorer.tell(robot.state()[0] + moved, torque)
        bad.append(explorer.counts["bad"])
    assert bad[LOST] == bad[-1] == LOST + 1
    assert np.abs(explorer._v).sum() > 0.0
    assert explorer.counts["windows"] > windows


def test_a_report_before_anything_is_learned_has_infinite_widths() -> None:
    """Once it warned of a division by 0, also of joints that did not move later."""
    joints = RobotExplorer(*small()).report()["joints"]
    assert [one["relative_width"] for one in joints.values()] == [np.inf] * 3


def test_a_gap_in_time_ends_the_window() -> None:
    explorer = RobotExplorer(*small())
    for k in range(10):
        torque = explorer.ask(np.zeros(3), 0.002 * k)
        explorer.tell(np.zeros(3), torque)
    assert len(explorer._rows) == 10
    explorer.ask(np.zeros(3), 0.5)
    assert (explorer.counts["late"], len(explorer._rows)) == (1, 0)


def test_bad_arguments_are_refused_with_a_remedy() -> None:
    given: tuple[tuple[dict[str, Any], str], ...] = (
        ({"inputs": "reference"}, "did you mean 'references'"),
        ({"friction": "dry"}, "coulomb_viscous, network"),
        ({"stop": {"stribeck": 0.1}}, "curve, viscous"),
        ({"stop": {"curve": 5.0}}, "below 1"),
    )
    for more, said in given:
        with pytest.raises(SpecificationError, match=said):
            pair(0, **more)
    with pytest.raises(SpecificationError, match="drives 6"):
        RobotExplorer(jaco()[0], small()[1])
    explorer = RobotExplorer(*small())
    with pytest.raises(ExplorationError, match="ask first"):
        explorer.tell(np.zeros(3))
    with pytest.raises(ExplorationError, match="encoders"):
        explorer.ask(np.full(3, np.nan))
    with pytest.raises(SpecificationError, match="3 real numbers"):
        explorer.ask(np.zeros(2))


def test_a_robot_that_its_torques_hardly_carry_is_refused() -> None:
    body, limits = small()
    weak = dataclasses.replace(limits, torque=0.01 * limits.torque)
    with pytest.raises(SpecificationError, match="more than 70 % of its limit of torque at rest"):
        RobotExplorer(body, weak)
