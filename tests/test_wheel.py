"""The wheel holds all that a launch and the analysis need, away from the repository."""

from __future__ import annotations

import os
import shutil
import site
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.dopt.test_custom_classes import TYPED
from tests.paths import ROOT

SOURCES = ("dopt", "orchestrate", "analysis", "conf")
FILES = ("pyproject.toml", "README.md", "LICENSE")
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")

pytestmark = pytest.mark.xdist_group("wheel")


def run(*command: str | Path, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a command that does not see the repository, whatever PYTHONPATH says to this process."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        list(map(str, command)),
        cwd=folder,
        env=environment | variables,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a wheel, built from a copy because a build leaves folders behind."""
    copy = tmp_path_factory.mktemp("sources")
    for name in SOURCES:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=ignored)
    for name in FILES:
        shutil.copy(ROOT / name, copy)
    done = run(
        *PIP, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", "out", ".", folder=copy
    )
    assert done.returncode == 0, done.stderr
    [path] = (copy / "out").glob("*.whl")
    return path


@pytest.fixture(scope="module")
def programs(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the programs of an environment with the wheel, and with our libraries behind it."""
    place = tmp_path_factory.mktemp("installed") / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", place, folder=ROOT)
    python = place / "bin/python"
    done = run(*PIP, "--python", python, "install", "--no-deps", "--no-index", wheel, folder=place)
    assert done.returncode == 0, done.stderr
    [packages] = place.glob("lib/python*/site-packages")
    (packages / "libraries.pth").write_text("\n".join(site.getsitepackages()))
    return place / "bin"


def test_every_source_and_every_setting_is_in_it(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    settings = {f"orchestrate/{path.relative_to(ROOT)}" for path in (ROOT / "conf").rglob("*.yaml")}
    sources = {
        str(path.relative_to(ROOT))
        for package in ("dopt", "orchestrate", "analysis")
        for path in (ROOT / package).rglob("*")
        if path.suffix in (".py", ".sh", ".env")
    }
    assert len(settings) > 20
    assert settings <= names
    assert sources <= names
    assert not {name.split("/")[0] for name in names} & {"tests", "benchmarks", "conf", "docker"}


def test_an_installed_launch_finds_its_settings(programs: Path, tmp_path: Path) -> None:
    grid = ("-m", "experiment=paper", "launch.dry_run=true")
    for launch in ((programs / "dopt-launch",), (programs / "python", "-m", "orchestrate.launch")):
        done = run(*launch, *grid, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "1,900 trials, 0 done, 1,900 to run" in done.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def crowded(tmp_path: Path) -> Path:
    """Return a working folder with modules of a user's own that have the names of our packages."""
    for name in ("analysis", "orchestrate", "dopt"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('the wrong module')\n")
    (tmp_path / "first").mkdir()  # on PYTHONPATH, before the installed packages
    shutil.copy(tmp_path / "analysis.py", tmp_path / "first")
    return tmp_path


@pytest.mark.parametrize("program", sorted(SCRIPTS))
def test_an_installed_program_explains_itself(programs: Path, crowded: Path, program: str) -> None:
    done = run(programs / program, "--help", folder=crowded, PYTHONPATH=str(crowded / "first"))
    assert (done.returncode, done.stderr) == (0, "")
    assert len(done.stdout.splitlines()) > 5
    wrong = run(programs / program, "--nope", folder=crowded)
    assert wrong.returncode == 2, wrong.stderr
    assert wrong.stderr.startswith("error: ")


@pytest.mark.parametrize("executor", ["local", "ray"])
def test_the_workers_of_an_installed_launch_import_our_packages(
    programs: Path, crowded: Path, executor: str
) -> None:
    (crowded / "first/held.py").write_text(TYPED)
    (crowded / "conf/policy").mkdir(parents=True)
    (crowded / "conf/policy/held.yaml").write_text("_target_: held.Held\n")
    words = ("--config-dir", "conf", "-m", "env=pendulum", "env.horizon=5", "policy=held")
    done = run(
        programs / "dopt-launch",
        *(*words, "seed=range(2)", f"executor={executor}", "launch.workers=1"),
        folder=crowded,
        PYTHONPATH=str(crowded / "first"),
    )
    assert done.returncode == 0, done.stderr
    assert "2 of 2 done, 0 failed" in done.stderr + done.stdout


def test_the_wheel_has_a_name_that_pip_knows_for_no_other_project(wheel: Path) -> None:
    assert wheel.name.startswith("dopt_exploration-")
    text = zipfile.ZipFile(wheel).read(f"{wheel.stem.split('-py3')[0]}.dist-info/METADATA").decode()
    wanted = [line for line in text.splitlines() if line.startswith("Requires-Dist: dopt")]
    assert wanted == [one for one in wanted if one.startswith("Requires-Dist: dopt-exploration[")]
    assert wanted
