"""Explorer of robots with a known body: limits, stops, payloads, and bad measurements."""

import mujoco
import numpy as np
import pytest

from dopt.errors import ExplorationError, SpecificationError
from dopt.robots.body import Body
from dopt.robots.explorer import RobotExplorer
from dopt.robots.friction import SPEEDS
from dopt.robots.limits import Limits
from dopt.robots.tracking import KnownBody
from studies.robots.online import LOOK, explore, true_values
from studies.robots.simulated import SimulatedRobot, jaco

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


def small() -> tuple[Body, Limits]:
    return Body(mujoco.MjModel.from_xml_string(ARM)), Limits(
        position=np.array([[-2.8, 2.8], [-1.5, 1.5], [-2.0, 2.0]]),
        velocity=np.array([2.0, 2.0, 3.0]),
        acceleration=np.full(3, 10.0),
        torque=np.array([40.0, 60.0, 25.0]),
    )


@pytest.mark.parametrize("arm", [small, jaco])
@pytest.mark.parametrize("seed", [0, 1])
def test_limits_are_kept_and_friction_is_learned(arm, seed: int) -> None:
    body, limits = arm()
    robot = SimulatedRobot(body, limits, seed)
    explorer = RobotExplorer(body, limits, seed=seed)
    trace = explore(robot, explorer, 3.0)
    assert trace.shares["position"] < 1.0
    assert trace.shares["velocity"] < 1.03
    assert trace.shares["torque"] <= 1.0
    assert np.median(trace.errors[-1]) < 0.1
    assert explorer.counts["changed"] == 0
    assert explorer.counts["windows"] == explorer.steps // explorer.learner.window.size


def test_references_keep_their_limits_exactly() -> None:
    body, limits = small()
    robot = SimulatedRobot(body, limits, 5)
    explorer = RobotExplorer(body, limits, seed=5)
    q = robot.state()[0]
    for _ in range(1500):
        torque = explorer.ask(q)
        assert (np.abs(explorer._a) <= limits.acceleration).all()
        assert (np.abs(explorer._v) <= limits.velocity).all()
        robot.step(torque)
        q = robot.state()[0]
        explorer.tell(q, torque)


def test_it_stops_when_every_interval_is_as_narrow_as_asked_for() -> None:
    body, limits = small()
    robot = SimulatedRobot(body, limits, 2)
    explorer = RobotExplorer(body, limits, stop={"curve": 0.15, "viscous": 0.3}, seed=2)
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
    assert explorer.report()["seconds"] == pytest.approx(before + 1.0)


def test_a_payload_is_noticed_said_once_and_weighed() -> None:
    body, limits = small()
    robot = SimulatedRobot(body, limits, 1, payload=(4.0, 0.8))
    explorer = RobotExplorer(body, limits, seed=1)
    own = explorer.known.model.body_mass[body.moved[-1]]
    explore(robot, explorer, 3.9)
    assert explorer.counts["changed"] == 0
    explore(robot, explorer, 4.0)
    assert explorer.counts["changed"] == 1
    assert "payload" in explorer.warnings[0]
    assert explorer.known.model.body_mass[body.moved[-1]] - own == pytest.approx(0.8, abs=0.15)
    assert body.model.body_mass[body.moved[-1]] == own


def test_a_hung_point_mass_adds_its_gravity_and_inertia() -> None:
    body = small()[0]
    known, last = KnownBody(body), body.moved[-1]
    place, mass = np.array([0.3, 0.05, -0.1]), 0.7
    known.hang(mass, mass * place)
    spec = mujoco.MjSpec.from_string(ARM)
    held = spec.bodies[last].add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-4, 0, 0])
    held.pos, held.mass = place, mass
    expected = KnownBody(Body(spec.compile()))
    q, v, a = np.array([0.3, -0.6, 0.9]), np.array([1.0, -0.5, 2.0]), np.array([3.0, 2.0, -1.0])
    zero = np.zeros(3)
    np.testing.assert_allclose(known.inverse(q, zero, zero), expected.inverse(q, zero, zero))
    # The inertia of the estimate is about any axis: it is the larger one.
    np.testing.assert_allclose(known.inverse(q, v, a), expected.inverse(q, v, a), rtol=0.35)


@pytest.mark.parametrize("friction", ["coulomb_viscous", "network"])
def test_torques_stay_on_the_ball_or_brake(friction: str) -> None:
    body, limits = small()
    robot = SimulatedRobot(body, limits, 3)
    explorer = RobotExplorer(body, limits, inputs="torques", friction=friction, gamma=0.2, seed=3)
    trace = explore(robot, explorer, 1.5)
    assert trace.shares["torque"] <= 1.0
    assert trace.shares["position"] < 1.02
    assert trace.shares["velocity"] < 1.1
    assert explorer.counts["plans"] == 0


def test_the_step_of_torques_is_the_best_on_the_ball() -> None:
    body, limits = small()
    explorer = RobotExplorer(body, limits, inputs="torques", friction="network", gamma=0.3)
    explorer.ask(np.zeros(3))
    learner, tracker = explorer.learner, explorer._tracker
    tracker.v[:] = [0.2, -0.1, 0.3]
    explorer._torques()
    p = learner.p

    def gain(u: np.ndarray) -> float:
        bias = explorer.known.inverse(tracker.q, tracker.v, np.zeros(3))
        inverse = np.linalg.inv(explorer.known.mass_matrix())
        idle = inverse @ (-bias - learner.torques(tracker.v))
        x = (tracker.v + explorer.dt * idle) / limits.velocity
        J = learner.model.jacobian(learner.mean[:, :p], x[:, None])[:, 0]
        bent = learner.model.slopes(learner.mean[:, :p], x[:, None])[1][:, 0]
        moved = explorer.dt * inverse @ u / limits.velocity
        rows = J + bent * moved[:, None]
        return float(np.einsum("np,npq,nq->", rows, learner.covariance[:, :p, :p], rows))

    bias = explorer.known.inverse(tracker.q, tracker.v, np.zeros(3))
    mass = explorer.known.mass_matrix()
    chosen = mass @ explorer._a + bias + learner.torques(tracker.v)
    assert np.linalg.norm(chosen / limits.torque) == pytest.approx(0.3)
    random = np.random.default_rng(0).standard_normal((3, 500))
    others = 0.3 * random / np.linalg.norm(random, axis=0) * limits.torque[:, None]
    assert gain(chosen) >= max(gain(u) for u in others.T) - 1e-12


@pytest.mark.parametrize("bad", [np.nan, 1.0])
def test_bad_measurements_are_counted_and_the_robot_brakes(bad: float) -> None:
    body, limits = small()
    robot = SimulatedRobot(body, limits, 4)
    explorer = RobotExplorer(body, limits, seed=4)
    explore(robot, explorer, 1.0)
    speed = np.abs(explorer._v).sum()
    for _ in range(40):
        wrong = robot.state()[0] + [0.0, bad, 0.0]
        torque = explorer.ask(wrong)
        assert np.isfinite(torque).all()
        robot.step(torque)
        explorer.tell(robot.state()[0] + [0.0, bad, 0.0], torque)
    assert explorer.counts["bad"] == 40
    assert np.abs(explorer._v).sum() < speed
    trace = explore(robot, explorer, 1.0)
    assert explorer.counts["bad"] == 40
    assert trace.shares["velocity"] < 1.03


def test_a_plan_that_is_late_leaves_the_joint_braking() -> None:
    body, limits = small()
    explorer = RobotExplorer(body, limits, deadline=1e-9)
    torque = explorer.ask(np.zeros(3))
    assert np.isfinite(torque).all()
    assert explorer.counts["late"] == 3
    assert explorer.counts["plans"] == 0
    np.testing.assert_array_equal(explorer._v, 0.0)


def test_a_gap_in_time_ends_the_window() -> None:
    body, limits = small()
    explorer = RobotExplorer(body, limits)
    for k in range(10):
        torque = explorer.ask(np.zeros(3), 0.002 * k)
        explorer.tell(np.zeros(3), torque)
    assert len(explorer._rows) == 10
    explorer.ask(np.zeros(3), 0.5)
    assert (explorer.counts["late"], len(explorer._rows)) == (1, 0)


def test_bad_arguments_are_refused_with_a_remedy() -> None:
    body, limits = small()
    with pytest.raises(SpecificationError, match="did you mean 'references'"):
        RobotExplorer(body, limits, inputs="reference")
    with pytest.raises(SpecificationError, match="coulomb_viscous, network"):
        RobotExplorer(body, limits, friction="dry")
    with pytest.raises(SpecificationError, match="curve, viscous"):
        RobotExplorer(body, limits, stop={"stribeck": 0.1})
    with pytest.raises(SpecificationError, match="below 1"):
        RobotExplorer(body, limits, stop={"curve": 5.0})
    with pytest.raises(SpecificationError, match="drives 6"):
        RobotExplorer(jaco()[0], limits)
    explorer = RobotExplorer(body, limits)
    with pytest.raises(ExplorationError, match="ask first"):
        explorer.tell(np.zeros(3))
    with pytest.raises(ExplorationError, match="encoders"):
        explorer.ask(np.full(3, np.nan))
    with pytest.raises(SpecificationError, match="3 real numbers"):
        explorer.ask(np.zeros(2))
