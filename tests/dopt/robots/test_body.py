"""Torques, regressors, limits and collisions of a robot, against MuJoCo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dopt.errors import SpecificationError
from dopt.robots.body import Body, Contacts, KnownBody, Motion, hang, point
from dopt.robots.limits import Limits, check_weight
from dopt.robots.parameters import Identifiability, Unknowns, count_null, relative_errors
from tests.paths import ROOT, printed

mujoco = pytest.importorskip("mujoco", reason="needs MuJoCo")

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" gravity="0.3 -0.2 -9.81"/>
  <worldbody>
    <body name="base" pos="0.1 0.2 0.3" euler="0.2 0.1 -0.4">
      <joint name="turn" axis="0 0 1" range="-2 2" pos="0.02 -0.03 0.1" armature="0.01"/>
      <inertial pos="0.05 0.02 0.1" mass="2" fullinertia="0.03 0.02 0.04 0.003 -0.002 0.001"/>
      <body name="link" pos="0.2 0 0.1" quat="0.9 0.1 0.3 0.2">
        <joint name="slide" type="slide" axis="1 0.5 0" range="-0.3 0.3" stiffness="7"
               springref="0.05"/>
        <inertial pos="-0.02 0.1 0.03" mass="1.5" fullinertia="0.02 0.03 0.03 -0.002 0.004 0.002"/>
        <body name="hand" pos="0 0.3 0" euler="1 0 0.3" gravcomp="0.4">
          <joint name="lift" axis="0 1 0" range="-1.5 1.5" ref="0.2" damping="0.4"/>
          <joint name="roll" axis="1 0 1" range="-3 3" frictionloss="0.3"/>
          <geom type="box" size="0.1 0.05 0.2" pos="0.1 0 0.2" euler="0.3 0.2 0.1" mass="0.7"/>
        </body>
      </body>
    </body>
    <body name="ball" pos="2 0 1"><freejoint/><geom size="0.1"/></body>
  </worldbody>
  <actuator>
    <motor joint="turn" ctrlrange="-20 20"/>
    <motor joint="slide" gear="3" ctrlrange="-20 20"/>
    <motor joint="lift" ctrlrange="-10 10"/>
    <motor joint="roll" ctrlrange="-5 5"/>
  </actuator>
</mujoco>
"""

LIMITS = "joints: {default: {velocity: 2, acceleration: 10}, turn: {velocity: 1.5}}"


def body_of(text: str) -> Body:
    return Body(mujoco.MjModel.from_xml_string(text))


def limits_of(body: Body, folder: Path, text: str) -> Limits:
    """Return the limits of a robot by the text of their file."""
    (folder / "limits.yaml").write_text(text)
    return Limits.of(body, folder / "limits.yaml")


@pytest.fixture
def arm() -> Body:
    return body_of(ARM)


@pytest.fixture
def limits(arm: Body, tmp_path: Path) -> Limits:
    return limits_of(arm, tmp_path, LIMITS)


def jaco() -> Body:
    pytest.importorskip("dm_control", reason="needs dm_control")
    from studies.robots import simulated

    return simulated.jaco()[0]


def random_motion(n: int, rows: int = 50) -> Motion:
    rng = np.random.default_rng(3)
    return Motion(0.01, *(size * rng.standard_normal((rows, n)) for size in (1.0, 2.0, 5.0)))


def inverse(body: Body, motion: Motion, model: object = None) -> np.ndarray:
    """Return the torques by the engine: passive forces of joints without damping and friction."""
    model = model or body.model
    data = mujoco.MjData(model)
    flags = model.opt.disableflags
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    found = []
    for q, v, a in zip(motion.positions, motion.velocities, motion.accelerations, strict=True):
        data.qpos[:] = model.qpos0
        data.qpos[body.addresses] = q
        data.qvel[body.dofs], data.qacc[body.dofs] = v, a
        mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse[body.dofs].copy())
    model.opt.disableflags = flags
    return np.array(found)


def test_torques_are_those_of_the_engine(arm: Body) -> None:
    assert arm.joints == ("turn", "slide", "lift", "roll")
    assert arm.bodies == ("base", "link", "hand")
    assert arm.notes == ("left out: joints taken to stay in their place: joint4 (free)",)
    for body in (arm, jaco()):
        damping = body.model.dof_damping.copy()
        motion = random_motion(body.n)
        body.model.dof_damping[:] = 0.0
        expected = inverse(body, motion)
        body.model.dof_damping[:] = damping
        scale = np.abs(expected).max()
        np.testing.assert_allclose(body.torques(motion), expected, atol=1e-12 * scale)


TWO = """
<mujoco><option %s</option><worldbody><body pos="0 0 1"><joint name="a" axis="0 1 0" %s/>
<geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.04" mass="3" fluidshape="ellipsoid"/>
<body name="b" pos="0.4 0 0" gravcomp="0.7"><joint name="b" axis="0 1 0.2" %s/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="2"/></body></body></worldbody>
<tendon><fixed name="t"><joint joint="a" coef="1"/></fixed></tendon>
<actuator><motor joint="a" gear="2" %s/><motor joint="b"/></actuator></mujoco>
"""


@pytest.mark.parametrize(
    "parts",
    [
        ('><flag gravity="disable"/>', "", "", ""),
        ('><flag invdiscrete="enable"/>', 'armature="0.2"', "", ""),
        ('density="1000" viscosity="3">', "", "", ""),
        (">", 'actuatorgravcomp="true"', 'actuatorgravcomp="true"', ""),
        (">", 'stiffness="4"', 'stiffness="3" springref="20" ref="10"', ""),
        ('><flag spring="disable"/>', 'stiffness="4"', "", ""),
        (">", 'damping="0.2 0.3" frictionloss="0.4"', 'damping="2"', ""),
        (">", 'armature="0.1"', "", 'armature="0.3" damping="0.4"'),
    ],
)
def test_torques_know_what_a_file_switches_off_and_adds(parts: tuple[str, ...]) -> None:
    """The engine's, less what the same model without damping lacks."""
    try:
        raw = mujoco.MjModel.from_xml_string(TWO % parts)
    except ValueError as error:  # actuators' armature, and damping of higher order
        pytest.skip(f"needs a newer MuJoCo: {error}")
    for name in ("dof_damping", "dof_dampingpoly", "actuator_damping"):
        if hasattr(raw, name):
            getattr(raw, name)[:] = 0.0
    raw.opt.enableflags = 0
    body, motion = body_of(TWO % parts), random_motion(2)
    expected = inverse(body, motion, raw)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(body.torques(motion), expected, atol=1e-12 * scale)


@pytest.mark.parametrize("name", ["mass", "com", "inertia", "armature", "damping"])
def test_regressors_are_derivatives_of_the_engine_s_torques(
    arm: Body, limits: Limits, name: str
) -> None:
    unknowns = Unknowns(arm, limits, name)
    motion = random_motion(arm.n, 10)
    rows = unknowns.regressor(motion)
    step = 1e-6
    for i, one in enumerate(unknowns.parameters):
        sides = []
        for sign in (1.0, -1.0):
            model = mujoco.MjModel.from_xml_string(ARM)
            change = sign * step * one.scale
            b = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, one.place)
            if one.kind == "mass":
                model.body_mass[b] += change
            elif one.kind.startswith("com"):
                model.body_ipos[b]["xyz".index(one.kind[-1])] += change
            elif one.kind.startswith("I"):
                model.body_inertia[b]["xyz".index(one.kind[-1])] += change
            else:
                dof = model.joint(one.place).dofadr[0]
                getattr(model, f"dof_{one.kind}")[dof] += change
            sides.append(inverse(arm, motion, model))
        expected = (sides[0] - sides[1]) / (2.0 * step)
        np.testing.assert_allclose(rows[:, :, i], expected, atol=1e-5 * max(1.0, np.ptp(expected)))


def test_regressors_at_other_values_are_derivatives_there(arm: Body, limits: Limits) -> None:
    """Differences between torques of bodies at values around those, in units of the old scales."""
    unknowns = Unknowns(arm, limits, "mass,com,inertia,armature,gear:lift")
    values = unknowns.values + 0.2 * unknowns.scales
    there, gears = unknowns.at(values)
    assert list(gears) == [1.0, 1.0, 1.2, 1.0]
    np.testing.assert_array_equal(there.scales, unknowns.scales)
    motion = random_motion(arm.n, 10)
    rows = there.regressor(motion)
    for i in range(len(unknowns) - 1):
        step = 1e-5 * unknowns.scales[i] * np.eye(len(unknowns))[i]
        more, less = (unknowns.at(values + way)[0].body.torques(motion) for way in (step, -step))
        expected = (more - less) / 2e-5
        np.testing.assert_allclose(rows[:, :, i], expected, atol=1e-5 * max(1.0, np.ptp(expected)))


@pytest.mark.parametrize("link", ["pos='.1 0 .2' euler='.3 .2 .1'", ""])
def test_what_hangs_on_a_body_moves_as_if_it_were_in_the_file(link: str) -> None:
    """Once it added its inertia about all axes, and its weight to a centre at 0 that stayed."""
    last = f"""<mujoco><worldbody><body pos="0 0 1" euler="1 .4 0"><joint axis="0 0 1"/>
        <geom size=".05" mass="1"/><body pos=".3 0 0"><joint axis="0 1 .5"/>
        <geom type="box" size=".03 .05 .2" {link} mass=".8"/>{{}}</body></body></worldbody></mujoco>
        """
    mass, centre, own = 0.6, np.array([0.1, -0.2, 0.15]), 0.4 * 0.6 * 0.04**2
    ball = f'<geom size=".04" pos="{" ".join(map(str, centre))}" mass="{mass}"/>'
    body, whole, motion = body_of(last.format("")), body_of(last.format(ball)), random_motion(2)
    known = KnownBody(body)
    for way in (1.0, -1.0):
        added = point(mass, mass * centre)
        added[4:7] += own
        hang(known.model, body.moved[-1], way * added)
        same = whole if way > 0.0 else body
        states = zip(motion.positions, motion.velocities, motion.accelerations, strict=True)
        found = np.array([known.inverse(*state) for state in states])
        np.testing.assert_allclose(found, same.torques(motion), atol=1e-9)


def test_dry_friction_and_gear(arm: Body, limits: Limits) -> None:
    motion = random_motion(arm.n)
    unknowns = Unknowns(arm, limits, "frictionloss:roll,gear:lift")
    dry, gear = np.moveaxis(unknowns.regressor(motion), 2, 0)
    fast = np.abs(motion.velocities[:, 3]) > 0.1
    np.testing.assert_allclose(dry[fast, 3], 0.3 * np.sign(motion.velocities[fast, 3]), rtol=1e-3)
    total = arm.torques(motion)[:, 2] + 0.4 * motion.velocities[:, 2]
    np.testing.assert_allclose(gear[:, 2], -total, rtol=1e-9)


def test_null_directions_change_no_torque_and_are_complete(arm: Body, limits: Limits) -> None:
    unknowns = Unknowns(arm, limits, "all")
    motion = random_motion(arm.n, 400)
    found = Identifiability.of(unknowns, motion, 500.0)
    rows = unknowns.regressor(motion).reshape(-1, len(unknowns))
    sizes = np.linalg.norm(rows, axis=0)
    rows = (rows / np.maximum(sizes, 1e-9 * sizes.max()))[:, sizes > 1e-9 * sizes.max()]
    rank = np.linalg.matrix_rank(rows, tol=1e-8 * np.linalg.norm(rows, 2))
    assert len(found.null) == len(unknowns) - rank > 0


def test_known_null_directions_in_words(tmp_path: Path) -> None:
    """Of a single hinge under gravity: centre along the axis and two moments have no effect."""
    body = body_of(
        """<mujoco><worldbody><body name="rod"><joint name="hinge" axis="0 1 0" range="-1 1"/>
        <inertial pos="0.3 0 0" mass="2" diaginertia="0.1 0.2 0.3"/></body></worldbody></mujoco>"""
    )
    given = "joints: {hinge: {velocity: 2, acceleration: 9, torque: 10}}"
    limits = limits_of(body, tmp_path, given)
    unknowns = Unknowns(body, limits, "mass,com,inertia,armature")
    null = Identifiability.of(unknowns, random_motion(1, 200), 100.0).null
    without = {f"{name}:rod has no effect" for name in ("com_y", "Ix", "Iz")}
    assert {text for text in null if "no effect" in text} == without
    assert "Iy:rod − armature:hinge" in null
    # m and c_x enter by m c_x and, with Iy, by the moment about the axis: one more.
    assert len(null) == 5


def test_errors_are_by_the_definition_and_scale_with_noise(arm: Body, limits: Limits) -> None:
    motion = random_motion(arm.n)
    exact, noisy = (
        Unknowns(arm, limits, "damping,mass", noise=noise).information(motion, 100.0)
        for noise in (0.01, 0.02)
    )
    np.testing.assert_allclose(exact, 4.0 * noisy, rtol=1e-12)
    rows = Unknowns(arm, limits, "damping,mass").regressor(motion)
    direct = sum(
        row.T @ np.diag(1.0 / (0.01 * limits.torque) ** 2) @ row for row in rows
    )  # one row each 10 ms is 100 Hz
    np.testing.assert_allclose(exact, direct, rtol=1e-9)
    expected = np.sqrt(np.diag(np.linalg.inv(direct + np.eye(len(direct)))))
    np.testing.assert_allclose(relative_errors(exact), expected, rtol=1e-9)


def test_limits_come_from_the_file_then_the_robot(limits: Limits) -> None:
    np.testing.assert_array_equal(limits.velocity, [1.5, 2.0, 2.0, 2.0])
    np.testing.assert_array_equal(limits.torque, [20.0, 60.0, 10.0, 5.0])
    np.testing.assert_allclose(limits.position[1], [-0.3, 0.3])


def test_friction_that_looks_like_a_default_is_said(arm: Body, tmp_path: Path) -> None:
    """Of a torque of 10 N m, at 2 rad/s: a damping of 0.004 N m s/rad is 0.08 %."""
    arm.model.dof_damping[arm.dofs] = [0.0, 0.0, 0.004, 0.02]
    said, *others = limits_of(arm, tmp_path, LIMITS).notes
    assert said.startswith("the damping of lift is less than 0.1 % of the limit of torque")
    assert not others


def test_limits_beyond_the_file_are_said(arm: Body, tmp_path: Path) -> None:
    wide = "turn: {position: [-2.1, 2]}, slide: {position: 0.3, torque: 61}, lift: {torque: 9}"
    assert limits_of(arm, tmp_path, f"joints: {{default: {{velocity: 2}}, {wide}}}").notes[:2] == (
        "the position of turn goes beyond the robot's file: check it",
        "the torque of slide goes beyond the robot's file: check it",
    )


def test_limits_that_look_like_defaults_are_said(tmp_path: Path) -> None:
    joints = "".join(
        f"""<link name="l{i + 1}"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1"
        izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j{i}" type="revolute">
        <parent link="l{i}"/><child link="l{i + 1}"/><axis xyz="0 1 0"/><origin xyz="0 0 0.2"/>
        <limit lower="-2" upper="2" effort="300" velocity="10"/></joint>"""
        for i in range(3)
    )
    source = tmp_path / "robot.urdf"
    source.write_text(f"""<robot name="r"><link name="l0"/>{joints}</robot>""")
    limits = Limits.of(Body.load(source))
    np.testing.assert_array_equal(limits.velocity, 10.0)
    said = " ".join(limits.notes)
    for size in ("velocity 10 rad/s", "torque 300 N m"):
        assert f"every joint has the {size}, which looks like a default" in said
    assert "no acceleration is given" in said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("joints: {wrist: {velocity: 2}}", "joint 'wrist' is unknown"),
        ("joints: {lift: {speed: 2}}", "limit of joint 'lift' 'speed' is unknown"),
        ("joints: {lift: {velocity: fast}}", "lift.velocity in .* is 'fast', but a number above 0"),
        ("joints: {lift: {torque: true}}", "lift.torque in .* is True, but a number above 0"),
        ("joints: {lift: {position: [1, 2, 3]}}", r"has the shape \(3,\) .* but 2 real numbers"),
        ("joints: {lift: {position: .nan}}", r"is \[nan, nan\], but finite numbers"),
        ("joints: {lift: {position: [2, 1]}}", r"is \[2, 1\], but \[low, high\]"),
        ("joints: {lift: 3}", "lift in .* is 3, but a mapping"),
        ("[1, 2]", "has no mapping 'joints'"),
        ("joints: {lift: [", "cannot be read"),
        ("joints: {lift: {velocity: 2}}", "velocity of turn"),
    ],
)
def test_limits_that_are_wrong_are_named(arm: Body, tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(SpecificationError, match=said):
        limits_of(arm, tmp_path, text)


def test_missing_limits_are_named_at_once_with_the_lines_to_fill_in(arm: Body) -> None:
    with pytest.raises(SpecificationError, match="velocity of turn and 3 more\\. Fill") as error:
        Limits.of(arm)
    lines = str(error.value).partition("\n")[2]
    assert lines == "joints:\n  default: {velocity: …}"
    arm.model.jnt_limited[arm.model.joint("slide").id] = 0
    with pytest.raises(SpecificationError, match="position of slide; velocity of turn") as error:
        Limits.of(arm)
    lines = str(error.value).partition("\n")[2]
    assert lines == "joints:\n  default: {velocity: …}\n  slide: {position: […, …]}"


def test_a_slide_has_units_of_its_own(arm: Body, limits: Limits) -> None:
    found = {one.name: one.unit for one in Unknowns(arm, limits, "all").parameters}
    assert found["damping:slide"] == "N s/m" != found["damping:lift"] == "N m s/rad"
    assert [found[f"{kind}:slide"] for kind in ("armature", "frictionloss")] == ["kg", "N"]
    assert found["gear:slide"] == "N/N" != found["gear:lift"] == "N m/N m"


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ("weight", "kind of parameter 'weight' is unknown"),
        ("mass:foot", "body 'foot' is unknown"),
        ("damping:base", "joint 'base' is unknown"),
        ("", "no unknown parameter is given"),
    ],
)
def test_wrong_parameters_are_named(arm: Body, limits: Limits, wanted: str, said: str) -> None:
    with pytest.raises(SpecificationError, match=said):
        Unknowns(arm, limits, wanted)


def test_all_null_directions_are_said_beside_one_of_a_tiny_moment(tmp_path: Path) -> None:
    """Masses, moments, friction and gears scale together: once that one of ten was lost."""
    body = body_of(
        """<mujoco><worldbody><body><joint axis="0 1 0" range="-2 2" damping="0.05"/>
        <inertial mass="0.26" pos="0 2e-6 0.08" diaginertia="1.2e-3 1.2e-3 3e-6"/>
        <body pos="0 0.04 0.135"><joint axis="0 1 0" range="-2 2" damping="0.05"/>
        <inertial mass="0.33" pos="0 1e-8 0.1" diaginertia="2.5e-3 2.5e-3 2e-6"/>
        </body></body></worldbody></mujoco>"""
    )
    given = "joints: {default: {velocity: 4, acceleration: 30, torque: 3}}"
    unknowns = Unknowns(body, limits_of(body, tmp_path, given), "all")
    motion = random_motion(2, 200)
    null = Identifiability.of(unknowns, motion, 100.0).null
    assert len(null) == count_null(unknowns, motion)
    assert any("gear" in text for text in null)


FLAT = """<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>
<link name="b"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="3" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
NEGATIVE = FLAT.replace('izz="3"', 'izz="-1"')


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<mujoco><worldbody/></mujoco>", "no hinge or slide"),
        ("<mujoco><worldbody>", "cannot be read"),
        (f'<robot name="r"><link name="a"/>{FLAT}</robot>', "put <mujoco><compiler balance"),
        (f'<robot name="r"><link name="a"/>{NEGATIVE}</robot>', "expected: correct it"),
        ("", "robot.xml"),
        ('<robot xmlns:xacro="x"><xacro:a/><link/></robot>', r"expand it \(xacro robot.xml"),
        (
            """<mujoco><asset><mesh name="m" file="none.stl"/></asset><worldbody><body><joint/>
            <geom type="mesh" mesh="m"/></body></worldbody></mujoco>""",
            "none.stl.*; without meshes: .*mass and inertia",
        ),
    ],
)
def test_files_that_are_no_robot_are_refused(tmp_path: Path, text: str, said: str) -> None:
    if text:
        (tmp_path / "robot.xml").write_text(text)
    with pytest.raises(SpecificationError, match=said):
        Body.load(tmp_path / "robot.xml")


FOLD = """<mujoco><worldbody><geom name="wall" type="plane" size="1 1 1"/>
    <body name="arm" pos="0 0 0.5"><joint name="hinge" axis="0 1 0" range="-2 2"/>
    <geom type="capsule" fromto="0 0 0 0.6 0 0" size="0.02"/></body></worldbody></mujoco>"""


def test_collisions_are_found_and_contacts_at_home_are_not() -> None:
    touching = body_of(FOLD).collisions(np.array([[0.0], [1.4], [-1.4]]))
    assert touching == [(1, "world", "arm")]  # the axis turns it down


def test_home_is_within_the_ranges_and_what_touches_there_is_named() -> None:
    """At 0, out of its range, the forearm is in the base; in the middle of the range it is not."""
    text = """<mujoco><worldbody><geom type="box" size="0.1 0.1 0.1"/>
        <body pos="0 0 0.3"><joint axis="0 1 0" range="-90 90"/>
        <geom size="0.02"/><body name="fore"><joint axis="0 1 0" range="{}"/>
        <geom type="capsule" fromto="0 0 -0.2 0 0 -0.4" size="0.02"/></body></body></worldbody>
        </mujoco>"""
    away, within = body_of(text.format("90 270")), body_of(text.format("-90 90"))
    np.testing.assert_allclose(away.home, [0.0, np.pi])
    assert away.notes == ()
    assert [pair for _, *pair in away.collisions(np.zeros((1, 2)))] == [["world", "fore"]]
    assert within.notes == (
        "left out: contacts less than 5 mm deeper than where the file puts them: world and fore",
    )
    assert within.collisions(np.zeros((1, 2))) == []


def test_bodies_that_touch_at_home_may_touch_as_deep_and_no_deeper() -> None:
    """Once they were not looked at, and a panda drove its wrist 49 mm into its forearm."""
    body = body_of(
        """<mujoco><worldbody><geom type="box" size="0.1 0.1 0.1"/>
        <body name="axle"><joint axis="0 0 1" range="-170 170"/>
        <geom pos="0 0 0.11" size="0.03"/>
        <body name="push" pos="0.12 0 0"><joint type="slide" axis="1 0 0" range="-0.05 0.2"/>
        <geom size="0.03"/></body></body></worldbody></mujoco>"""
    )
    assert body.notes == (
        "left out: contacts of bodies that touch in all positions: world and axle",
        "left out: contacts less than 5 mm deeper than where the file puts them: world and push",
    )
    places = np.array([[0.0, 0.0], [0.0, -0.004], [0.0, -0.006], [0.0, 0.1]])
    assert body.collisions(places) == [(2, "world", "push")]
    assert Contacts(body, 0.01, 0.03).room(places[0]) == pytest.approx(0.001, abs=1e-6)
    assert Contacts(body, 0.01, 0.03).room(places[1]) < 0.0


def test_room_is_the_distance_beyond_the_one_to_keep() -> None:
    body = body_of(
        """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
        <body pos="0 0 0.05"><joint axis="0 1 0" range="-2 2"/>
        <geom type="sphere" pos="0.5 0 0" size="0.02"/>
        <body pos="0.5 0 0.2"><joint type="slide" axis="0 0 1" range="-0.3 0.3"/>
        <geom type="sphere" size="0.03"/></body></body></worldbody></mujoco>"""
    )
    contacts = Contacts(body, 0.02, 0.05)
    # At home the ball is 0.03 above the floor, and keeps half of that.
    assert contacts.room(np.zeros(2)) == pytest.approx(0.015)
    assert contacts.room(np.array([0.04, 0.0])) == pytest.approx(0.015 - 0.5 * np.sin(0.04))
    assert contacts.room(np.array([0.2, 0.0])) < 0.0
    assert contacts.room(np.array([-1.0, 0.0])) == pytest.approx(0.03)  # nothing within 0.05
    levers = contacts.levers(np.array([[-2.0, 2.0], [-0.3, 0.3]]))
    assert levers == pytest.approx([np.hypot(0.5, 0.5) + 0.03, 1.0], abs=0.02)


def test_without_mujoco_one_sentence_says_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    text = """
import sys
sys.modules["mujoco"] = None
from dopt.errors import SpecificationError
from dopt.robots import Body, RobotExplorer
try:
    Body.load(sys.argv[1])
except SpecificationError as error:
    print(error)
"""
    said = printed(text, str(tmp_path / "arm.xml"))
    assert "a robot needs MuJoCo, which is not installed: pip install" in said


@pytest.mark.parametrize("package", ["arm_description", "renamed"])
def test_meshes_of_a_ros_package_are_found_in_its_folder(tmp_path: Path, package: str) -> None:
    """Once they counted as not there, and contacts of their bodies were not looked at."""
    for folder in ("urdf", "meshes"):
        (tmp_path / package / folder).mkdir(parents=True)
    corners = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\n"
    faces = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (tmp_path / package / "meshes" / "link.obj").write_text(corners + faces)
    source = tmp_path / package / "urdf" / "arm.urdf"
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    source.write_text(
        f"""<robot name="r"><link name="base"/><link name="link"><inertial>
        <mass value="1"/>{inertia}</inertial><collision><geometry>
        <mesh filename="package://arm_description/meshes/link.obj"/></geometry></collision></link>
        <joint name="j" type="revolute"><parent link="base"/><child link="link"/>
        <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="9" velocity="2"/></joint></robot>"""
    )
    body = Body.load(source)
    assert (body.model.nmesh, body.notes) == (1, ())


@pytest.mark.parametrize("mesh", ["link.stl", "link.dae", "flat.stl"])
def test_meshes_that_are_not_there_or_not_read_are_said(tmp_path: Path, mesh: str) -> None:
    """Collada is what many packages of ROS have: such robots were once refused."""
    (tmp_path / "link.dae").write_text("<COLLADA/>")
    (tmp_path / "flat.stl").write_bytes(bytes(84))
    (tmp_path / "arm.xml").write_text(
        f"""<mujoco><asset><mesh name="m" file="{mesh}"/></asset><worldbody>
        <body><joint name="a"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
    )
    body = Body.load(tmp_path / "arm.xml")
    said = f"left out: meshes and their contacts, for one cannot be read: {mesh}"
    assert (body.model.ngeom, body.notes) == (0, (said,))


def test_a_file_that_the_engine_warns_of_writes_nothing(tmp_path: Path) -> None:
    text = ARM.replace('angle="radian"', 'angle="radian" settotalmass="7"')
    (tmp_path / "arm.xml").write_text(text)
    code = "from dopt.robots import Body; print(*Body.load('arm.xml').joints)"
    assert printed(code, folder=tmp_path, PYTHONPATH=str(ROOT)) == "turn slide lift roll\n"
    assert [one.name for one in tmp_path.iterdir()] == ["arm.xml"]


def test_what_is_left_out_is_named() -> None:
    body = body_of(
        """<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
        <body><freejoint name="root"/><geom size="0.1"/>
        <body><joint name="a" axis="0 1 0"/><geom size="0.1"/>
        <body><joint name="b" axis="0 1 0"/><geom size="0.1"/>
        <body><joint name="c" type="ball"/><geom size="0.1"/>
        </body></body></body></body></worldbody>
        <tendon><fixed name="rope" frictionloss="1"><joint joint="b" coef="1"/></fixed></tendon>
        <equality><joint name="mimic" joint1="b" joint2="a"/></equality>
        <actuator><motor joint="a"/><motor name="pull" tendon="rope"/></actuator></mujoco>"""
    )
    assert body.joints == ("a",)
    assert body.notes == (
        "left out: joints taken to stay in their place: root (free), b, c",
        "left out: actuators that move no hinge or slide alone: pull",
        "left out: equality constraints: mimic",
        "left out: dry friction of tendons: rope",
    )


TIED = """<mujoco><worldbody><body name="one"><joint name="a" axis="0 1 0"/><geom size="0.1"/>
    <site name="tip"/><site name="end"/>
    <body name="two" pos="0 0 1"><joint name="b" axis="0 1 0"/><geom size="0.1"/></body>
    </body></worldbody><equality>%s</equality><actuator><motor joint="a"/>%s</actuator>
    </mujoco>"""


BOTH = '<motor joint="b"/>'


@pytest.mark.parametrize(
    ("tie", "motors", "tied"),
    [
        ('<connect body1="two" anchor="0 0 0"/>', "", True),
        ('<connect body1="two" anchor="0 0 0" active="false"/>', BOTH, False),
        ('<weld body1="one" body2="two"/>', "", False),
        ('<weld body1="one" body2="two"/>', BOTH, True),
        ('<weld site1="tip" site2="end"/>', BOTH, False),
        ('<joint joint1="a" joint2="b"/>', "", False),
        ('<joint joint1="a" joint2="b"/>', BOTH, True),
        ('<joint joint1="a"/>', "", True),
        ('<joint joint1="b"/>', "", False),
    ],
)
def test_constraints_that_driven_joints_would_break_are_refused(
    tie: str, motors: str, tied: bool
) -> None:
    """Closed loops were once left out in a note, though no design could be driven."""
    model = mujoco.MjModel.from_xml_string(TIED % (tie, motors))
    if not tied:
        assert Body(model).joints[0] == "a"
        return
    with pytest.raises(
        SpecificationError, match=r"equality0 \((connect|weld|joint) of .* ties"
    ) as error:
        Body(model)
    assert "take it from the file" in str(error.value)
    assert ("of a" if "joint1" in tie else "two") in str(error.value)


def test_a_joint_that_mimics_another_is_not_driven(tmp_path: Path) -> None:
    joint = """<joint name="{0}" type="prismatic"><parent link="{1}"/><child link="{0}"/>
      <axis xyz="0 1 0"/><limit lower="0" upper="0.04" effort="20" velocity="0.2"/>{2}</joint>"""
    link = """<link name="{0}"><inertial><mass value="0.1"/>
      <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    links = "".join(link.format(name) for name in ("hand", "left", "right"))
    mimic = joint.format("right", "hand", '<mimic joint="left" multiplier="-1"/>')
    (tmp_path / "gripper.urdf").write_text(
        f'<robot name="r">{links}{joint.format("left", "hand", "")}{mimic}</robot>'
    )
    body = Body.load(tmp_path / "gripper.urdf")
    assert body.joints == ("left",)
    assert body.notes[0] == "left out: joints taken to stay in their place: right"
    limits = Limits.of(body)
    assert (limits.torque, limits.velocity) == ([20.0], [0.2])
    text = (tmp_path / "gripper.urdf").read_text()
    (tmp_path / "gripper.urdf").write_text(f'\n<?xml version="1.0"?>{text}')
    assert Limits.of(Body.load(tmp_path / "gripper.urdf")).velocity == [0.2]
    (tmp_path / "gripper.urdf").write_text(text.replace("</robot>", "<a:b/></robot>"))
    with pytest.raises(SpecificationError, match="velocity of left"):
        Limits.of(Body.load(tmp_path / "gripper.urdf"))


def test_limits_of_joints_without_names_and_of_actuators_with_two_limits(tmp_path: Path) -> None:
    """A joint's torque is what its control, its force and the joint itself allow, all of them."""
    body = body_of(
        """<mujoco><worldbody><body><joint/><geom size="0.1"/>
        <body><joint name="b"/><geom size="0.1"/>
        <body><joint name="c" actuatorfrcrange="-5 5"/><geom size="0.1"/></body></body></body>
        </worldbody><actuator><motor joint="b" gear="50" ctrlrange="-1 1" forcerange="-100 100"/>
        <position joint="c" kp="9" forcerange="-2 2" gear="2" ctrlrange="-1 1"/></actuator>
        </mujoco>"""
    )
    given = "joints: {default: {position: 1, velocity: 2}}"
    np.testing.assert_array_equal(limits_of(body, tmp_path, given).torque, [50.0, 4.0])
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint/><geom size="0.1"/></body></worldbody></mujoco>"""
    )
    found = limits_of(Body(model), tmp_path, given.replace("2", "2, torque: 3"))
    assert Body(model).joints == ("joint0",)
    assert found.torque == [3.0]


def test_a_joint_that_cannot_carry_its_weight_is_named(tmp_path: Path) -> None:
    body = body_of(
        """<mujoco><worldbody><body><joint name="z" type="slide" axis="0 0 1" range="0 1"/>
        <geom size="0.1" mass="6"/><body><joint name="arm" axis="0 1 0" range="70 115"/>
        <geom size="0.1" pos="0 0 1" mass="3"/></body></body></worldbody></mujoco>"""
    )
    given = "joints: {default: {velocity: 1}, arm: {torque: %s}, z: {torque: %s}}"
    for arm, slide, said in (
        (99, 80, "'z' takes 88.3 N at rest.*limit of torque is 80 N"),
        (20, 99, "'arm' takes 26.* N m at rest.*limit of torque is 20 N m: give"),
    ):
        with pytest.raises(SpecificationError, match=said):
            check_weight(body, limits_of(body, tmp_path, given % (arm, slide)))
    check_weight(body, limits_of(body, tmp_path, given % (29, 99)))
