"""Public names and what they load, unknown names, given paths, usable cores, missing modules."""

from __future__ import annotations

import ast
import importlib.metadata
import logging
import os
import pwd
from collections.abc import Callable
from pathlib import Path

import pytest

import dopt
from analysis.outputs import versions
from dopt import process
from dopt.errors import SpecificationError, _say_once, counted, given_path, unknown_name
from orchestrate.runner.saving import launch_record
from tests.dopt.explorer.plants import MOTOR
from tests.paths import ROOT, loaded_by, printed

HEAVY = {"torch", "ray", "numba", "hydra", "sqlalchemy", "matplotlib", "pandas", "scipy"}


def test_the_import_loads_no_library_and_a_specification_numpy_alone() -> None:
    program = "import sys, dopt; assert not {'numpy', 'scipy', 'numba'} & sys.modules.keys(); "
    program += "dopt.TrialSpec.from_names('pendulum', 'd_optimal'); dopt.TrialResult"
    assert not {name.split(".")[0] for name in loaded_by(program)} & HEAVY


def test_every_public_name_is_there() -> None:
    for name in dopt.__all__:
        assert name in dir(dopt)
        assert getattr(dopt, name) is getattr(dopt, name)
        with pytest.raises(AttributeError, match=f"has no attribute '{name}l'"):
            getattr(dopt, f"{name}l")


def test_the_version_is_that_of_the_code_and_not_of_another_project(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Environments may hold a distribution named dopt: a stranger's, or this one's before."""
    (tmp_path / "dopt-0.0.6.dist-info").mkdir()
    (tmp_path / "dopt-0.0.6.dist-info/METADATA").write_text("Name: dopt\nVersion: 0.0.6\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert importlib.metadata.version("dopt") == "0.0.6"
    versions.cache_clear()
    assert versions()["dopt"] == dopt.__version__
    assert launch_record([], [], ROOT).versions["dopt"] == dopt.__version__


def test_a_type_checker_sees_the_names_where_they_are() -> None:
    tree = ast.parse(Path(dopt.__file__).read_text())
    blocks = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {
        alias.asname: node.module
        for block in blocks
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == dopt._MODULES
    assert set(dopt.__all__) == {*seen, "__version__"}


NAMES = ("random", "d_optimal", "first/random_held", "first/prbs", "second/exact", "second/max")


@pytest.mark.parametrize(
    ("given", "nearest"),
    [
        ("d_optimla", "d_optimal"),
        ("secnd/exact", "second/exact"),
        ("first/exact", "second/exact"),
        ("second/random", "random"),
        ("prbs", "first/prbs"),
        ("random_hold", "first/random_held"),
        ("mxa", "second/max"),
    ],
)
def test_the_nearest_name_counts_its_folder_or_not(given: str, nearest: str) -> None:
    message = str(unknown_name("policy", given, NAMES))
    start = f"policy '{given}' is unknown: did you mean '{nearest}'? Choose one of d_optimal, "
    assert message.startswith(start)


@pytest.mark.parametrize("given", ["", "wxyz", None, 7])
def test_no_name_is_suggested_where_none_is_near(given: object) -> None:
    assert str(unknown_name("policy", given, NAMES)).endswith(
        "is unknown: choose one of d_optimal, first/prbs, first/random_held, random, "
        "second/exact, second/max."
    )
    nothing = str(unknown_name("field", "form", ()))
    assert nothing.endswith("is unknown, no field exists: remove it.")


def test_the_nearest_name_counts_its_section_and_no_dashes() -> None:
    assert "did you mean 'env.dt'" in str(unknown_name("setting", "dt", ("width", "env.dt")))
    options = ("--json", "--until", "--timeout")
    assert "unknown: choose one of" in str(unknown_name("option", "--for", options))
    assert "did you mean '--timeout'" in str(unknown_name("option", "--time", options))


@pytest.mark.parametrize(("number", "text"), [(0, "0 rows"), (1, "1 row"), (2000, "2,000 rows")])
def test_one_thing_is_no_plural(number: int, text: str) -> None:
    assert counted(number, "row") == text


# Paths that users give, as one function reads them

PLAIN = ["r.db", "/a/b c.db", "price$", "a$-b", "./~x", "%7E/x", "./ x", "é", "a~b", "\udcff.db"]
REFUSED = ["", " \n", "$HOME/r.db", "/data/$USER/r.db", "${HOME}/x", "$(pwd)/x", "~nobody-here/x"]


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    _say_once.cache_clear()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "home"


@pytest.mark.usefixtures("home")
def test_a_path_stays_as_it_is(caplog: pytest.LogCaptureFixture) -> None:
    assert [given_path(given, "--out") for given in PLAIN] == [*map(Path, PLAIN)]
    assert not caplog.records


@pytest.mark.usefixtures("home")
def test_what_is_around_a_path_is_left_out_with_one_note(caplog: pytest.LogCaptureFixture) -> None:
    for around in ("{} ", " {}", "{}\n", "{}\r\n", "\t{} \n", "{}\N{NO-BREAK SPACE}"):
        assert given_path(around.format("x/r.db"), "DOPT_CACHE") == Path("x/r.db")
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.message == "DOPT_CACHE: the blanks or line ends around it are left out"


def test_a_tilde_is_the_home_folder(home: Path) -> None:
    assert given_path("~", "--out") == home
    assert given_path("~/x/r.db", "--out") == home / "x/r.db"
    assert given_path("~root/r.db", "--out") == Path(pwd.getpwnam("root").pw_dir, "r.db")


CODE = r"--out holds the control character '\\\w+'"


@pytest.mark.usefixtures("home")
@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        *((given, r"--out is '.*give") for given in REFUSED),
        *((given, CODE) for given in ("a\nb", "a\0b", "a\x1b[2Jb", "a\x9bb")),
    ],
)
def test_what_a_shell_expands_and_control_characters_are_refused(given: str, sentence: str) -> None:
    with pytest.raises(SpecificationError, match=sentence):
        given_path(given, "--out")


@pytest.mark.usefixtures("home")
def test_a_folder_that_is_named_like_a_variable_is_found(tmp_path: Path) -> None:
    (tmp_path / "$HOME").mkdir()
    (tmp_path / "a${b}c").mkdir()
    assert given_path("$HOME/r.db", "--out") == Path("$HOME/r.db")
    assert given_path(f"{tmp_path}/a${{b}}c/r.db", "--out") == tmp_path / "a${b}c/r.db"
    with pytest.raises(SpecificationError, match=r"\$X is expanded by a shell"):
        given_path("$HOME/$X/r.db", "--out")


def test_a_journal(home: Path) -> None:
    dopt.Explorer(MOTOR, journal="~/runs/one.jsonl\n").close()
    assert [path.name for path in (home / "runs").iterdir()] == ["one.jsonl"]
    with pytest.raises(SpecificationError, match=r"journal is '\$HOME/one.jsonl'"):
        dopt.Explorer(MOTOR, journal="$HOME/one.jsonl")


# Cores that a process may use

Group = Callable[..., None]


@pytest.fixture
def group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Group:
    """Return a function that puts this process, on eight cores, into a control group."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {*range(8)})
    monkeypatch.setattr(process, "PROC", tmp_path)

    def put(kind: str, groups: str, quotas: dict[str, str], root: str = "/") -> None:
        (tmp_path / "cgroup").write_text(groups)
        options = "rw,nsdelegate" if kind == "cgroup2" else "rw,cpuacct,cpu"
        (tmp_path / "mountinfo").write_text(
            f"30 23 0:2 / /proc rw shared:1 - proc proc rw\n"
            f"31 23 0:28 {root} {tmp_path}/fs rw,relatime shared:9 - {kind} cgroup {options}\n"
        )
        for name, quota in quotas.items():
            path = tmp_path / "fs" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(quota)

    return put


def test_without_a_group_the_affinity_counts(group: Group, tmp_path: Path) -> None:
    assert process.usable_cores() == 8  # no file says anything
    group("cgroup2", "0::/\n", {"cpu.max": "max 100000\n"})
    assert process.usable_cores() == 8
    group("cgroup", "4:cpu,cpuacct:/\n", {"cpu.cfs_quota_us": "-1", "cpu.cfs_period_us": "100000"})
    assert process.usable_cores() == 8
    (tmp_path / "mountinfo").write_text("of another kind\n")
    assert process.usable_cores() == 8


@pytest.mark.parametrize(
    ("quota", "expected"), [("50000", 1), ("150000", 1), ("200000", 2), ("900000", 8)]
)
@pytest.mark.parametrize("version", [1, 2])
def test_a_quota_counts_in_whole_cores(
    group: Group, quota: str, expected: int, version: int
) -> None:
    if version == 2:
        group("cgroup2", "0::/a/b\n", {"a/b/cpu.max": f"{quota} 100000\n"})
    else:
        files = {"a/b/cpu.cfs_quota_us": quota, "a/b/cpu.cfs_period_us": "100000"}
        group("cgroup", "5:memory:/m\n4:cpu,cpuacct:/a/b\n", files)
    assert process.usable_cores() == expected


def test_the_smallest_quota_counts_up_to_the_top_that_a_container_sees(group: Group) -> None:
    quotas = {"a/cpu.max": "300000 100000", "a/b/cpu.max": "max 100000", "a/b/c/cpu.max": "5 1"}
    group("cgroup2", "0::/a/b/c\n", quotas)
    assert process.usable_cores() == 3
    # In a container what is mounted begins at its own group, while its path is that on the host.
    files = {"cpu.cfs_quota_us": "250000", "cpu.cfs_period_us": "100000"}
    group("cgroup", "4:cpu,cpuacct:/docker/1f\n", files, root="/docker/1f")
    assert process.usable_cores() == 2
    files = {"job/cpu.cfs_quota_us": "100000", "job/cpu.cfs_period_us": "100000"}
    group("cgroup", "4:cpu,cpuacct:/docker/1f/job\n", files, root="/docker/1f")
    assert process.usable_cores() == 1


def test_nothing_else_counts_cores() -> None:
    counting = ("cpu_count", "sched_getaffinity(0))")
    found = [
        str(path.relative_to(ROOT))
        for package in ("dopt", "orchestrate", "analysis", "benchmarks")
        for path in (ROOT / package).rglob("*.py")
        if any(words in path.read_text() for words in counting)
    ]
    assert found == ["dopt/process.py"]


PROGRAM = """
import sys
for name in ("fcntl", "pwd", "resource", "grp", "termios"):
    sys.modules[name] = None
import numpy as np
import dopt
plant = dopt.Plant(
    states={"angle": "rad", "rate": "rad/s"}, inputs={"voltage": "V"}, dt=0.02, gamma=3.0,
    known={"angle": "rate", "rate": "gain * voltage"}, constants={"gain": dopt.unknown(5.0)},
    learned=["rate"], angles=["angle"], box={"rate": 5.0}, measured={"angle": 0.001},
)
t, u = np.arange(300) * 0.02, np.sign(np.sin(np.arange(300)))
rate = np.concatenate([[0.0], np.cumsum(0.02 * 6.0 * u)[:-1]])
angle = np.concatenate([[0.0], np.cumsum(0.02 * (rate[:-1] + 0.5 * 0.02 * 6.0 * u[:-1]))])
log = dopt.Log.for_plant({"time": t, "angle": angle, "voltage": u}, plant)
found = dopt.fit(plant, log, width=0, workers=1)
assert abs(found.constants["gain"][0] - 6.0) < 0.02, found.constants
with dopt.Explorer(plant, policy="random", learner="joint_ekf", steps=20, journal="run.jsonl") as e:
    for k in range(5):
        e.ask([float(angle[k])])
        e.tell([float(angle[k + 1])])
    assert e.n_steps == 5
print("done")
"""


def test_log_fit_and_explorer_run(tmp_path: Path) -> None:
    assert printed(PROGRAM, folder=tmp_path, PYTHONPATH=str(ROOT)) == "done\n"
