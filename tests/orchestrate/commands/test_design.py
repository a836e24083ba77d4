"""Command ``design``: what it prints and writes for a robot that no other test knows."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from orchestrate.__main__ import main
from orchestrate.errors import ExitCode

pytest.importorskip("mujoco", reason="needs MuJoCo")

ROBOT = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="2 2 1"/>
  <body name="upper" pos="0 0 0.8"><joint name="shoulder" axis="0 1 0" range="-1.5 1.5"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.04" mass="2"/>
    <body name="lower" pos="0 0 0.4"><joint name="elbow" axis="0 1 0" range="-2 2"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.03" mass="1"/></body></body>
</worldbody><actuator>
  <motor joint="shoulder" ctrlrange="-40 40"/><motor joint="elbow" ctrlrange="-15 15"/>
</actuator></mujoco>
"""
LIMITS = "joints: {default: {velocity: 2, acceleration: 8}}"


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    (tmp_path / "robot.xml").write_text(ROBOT)
    (tmp_path / "limits.yaml").write_text(LIMITS)
    return tmp_path / "robot.xml"


def designed(robot: Path, *words: str) -> int:
    limits = str(robot.with_name("limits.yaml"))
    return main(["design", str(robot), "--limits", limits, *words])


def test_check_names_what_no_motion_can_tell(
    robot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert designed(robot, "--unknown", "mass,inertia,damping", "--check") == ExitCode.DONE
    text = capsys.readouterr().out
    assert "Ix:upper has no effect" in text
    assert "damping:elbow" in text
    assert "95 % intervals" in text


def test_a_design_is_written_as_csv_picture_and_trajectory(
    robot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, ros = robot.with_name("excitation.csv"), robot.with_name("excitation.yaml")
    words = ["--unknown", "damping,frictionloss", "--seconds", "4", "--effort", "6", "--json"]
    code = designed(robot, *words, "--out", str(out), "--ros", str(ros), "--rate", "200")
    assert code == ExitCode.DONE
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert "multisine, best of 25" in captured.err  # progress
    names = [row["name"] for row in document["candidates"]]
    assert names[0] == document["best"]
    assert {"multisine", "ladder", "spline"} <= set(names)
    assert all(0 < row["share"] <= 1 for row in document["candidates"])
    assert max(document["limits"].values()) <= 1.0
    with out.open() as file:
        rows = list(csv.reader(file))
    head = ["time"] + [f"{k}_{j}" for k in ("q", "dq", "ddq", "tau") for j in ("shoulder", "elbow")]
    assert rows[0] == head
    numbers = np.array(rows[1:], dtype=float)
    assert len(numbers) == 800
    assert np.abs(numbers[:, 3:5]).max() <= 2.0
    assert np.abs(numbers[[0, -1], 3:5]).max() < 1e-6
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    trajectory = yaml.safe_load(ros.read_text())
    assert trajectory["joint_names"] == ["shoulder", "elbow"]
    point = trajectory["points"][-1]
    assert point["time_from_start"] == {"sec": 3, "nanosec": 990000000}
    np.testing.assert_allclose(point["positions"], numbers[798, 1:3], atol=1e-8)


def test_names_with_marks_are_kept_in_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A body whose name looks like a wildcard was once unknown; a comma made a column more."""
    shoulder, elbow = 'left, "$a$"', "link[2]"
    text = ROBOT.replace('"shoulder"', "'left, &quot;$a$&quot;'").replace('"elbow"', f'"{elbow}"')
    (tmp_path / "robot.xml").write_text(text.replace('"lower"', '"lower[1]"'))
    (tmp_path / "limits.yaml").write_text(LIMITS)
    out = tmp_path / "motion.csv"
    words = ["--unknown", f"mass:lower[1],damping:{elbow}", "--seconds", "2", "--effort", "1"]
    assert designed(tmp_path / "robot.xml", *words, "--out", str(out)) == ExitCode.DONE
    assert "mass:lower[1]" in capsys.readouterr().out
    with out.open() as file:
        rows = list(csv.reader(file))
    assert rows[0][1:3] == [f"q_{shoulder}", f"q_{elbow}"]
    assert len(rows[1]) == 9


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--unknown", "weight", "--check"], "kind of parameter 'weight' is unknown"),
        (["--unknown", "mass:tool", "--check"], "body 'tool' is unknown"),
        (["--unknown", "mass", "--check", "--out", "x.csv"], "leave out --out"),
        (["--unknown", "mass", "--seconds", "-3"], "--seconds is '-3', a number above 0"),
        (["--check"], "--unknown"),
    ],
)
def test_wrong_inputs_are_one_sentence(
    robot: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    assert designed(robot, *words) == ExitCode.BAD_REQUEST
    captured = capsys.readouterr()
    assert said in captured.err
    assert "Traceback" not in captured.err


def test_a_folder_that_cannot_be_written_is_said_before_the_search(
    robot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = designed(robot, "--unknown", "damping", "--out", str(robot / "motion.csv"))
    assert code != ExitCode.DONE
    assert "cannot be written" in capsys.readouterr().err
    assert designed(robot, "--unknown", "damping", "--ros", str(robot / "motion.yaml")) == code
    error = capsys.readouterr().err
    assert "another --ros" in error
    assert "multisine" not in error


def test_slow_sensors_hide_no_parameter_and_short_motions_have_rows(
    robot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What no motion can tell is a property of the robot, not of the rows of a measurement."""
    words = ["--unknown", "all", "--json"]
    assert designed(robot, *words, "--check", "--rate", "0.5") == ExitCode.DONE
    assert len(json.loads(capsys.readouterr().out)["null"]) == 10
    assert designed(robot, *words, "--seconds", "0.05", "--effort", "2") == ExitCode.DONE


@pytest.mark.parametrize(
    "words",
    [
        ["--out", "motion.png"],
        ["--out", "motion.csv", "--ros", "./motion.csv"],
        ["--out", "robot.xml"],
        ["--ros", "limits.yaml"],
    ],
)
def test_no_file_is_written_twice_or_over_one_that_is_read(
    robot: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
) -> None:
    monkeypatch.chdir(robot.parent)
    before = {one: one.read_bytes() for one in robot.parent.iterdir()}
    assert designed(robot, "--unknown", "damping", *words) == ExitCode.BAD_REQUEST
    assert "have a name twice" in capsys.readouterr().err
    assert {one: one.read_bytes() for one in robot.parent.iterdir()} == before
