"""Agreement of the files that repeat a version, and of the pins with Debian's Python."""

from __future__ import annotations

import contextlib
import re
import tomllib
from importlib import metadata

import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

import dopt
from dopt.errors import DISTRIBUTION, install_command
from tests.paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
METADATA = PROJECT["project"]
WRITTEN = (".ipynb", ".md", ".py", ".sh", ".yaml", ".html")
"""Endings of the files in which people and machines read commands."""

FOLDERS = ("analysis", "benchmarks", "conf", "docker", "docs", "dopt", "orchestrate", "studies")

UNTESTED = {"torch"}
"""Libraries whose lower bound is not tested; constraints-lowest.txt says why."""


def pins(name: str) -> dict[str, str]:
    lines = (ROOT / name).read_text().splitlines()
    pairs = (line.split("==") for line in lines if not line.startswith("#"))
    return {canonicalize_name(library): version for library, version in pairs}


def lower_bounds() -> dict[str, str]:
    extras = METADATA["optional-dependencies"]
    texts = [*METADATA["dependencies"], *(text for extra in extras.values() for text in extra)]
    wanted = [Requirement(text) for text in texts if not text.startswith(f"{METADATA['name']}[")]
    return {
        canonicalize_name(library.name): specifier.version
        for library in wanted
        for specifier in library.specifier
        if specifier.operator == ">="
    }


def test_the_lowest_versions_are_the_lower_bounds() -> None:
    bounds, lowest = lower_bounds(), pins("constraints-lowest.txt")
    assert bounds.keys() == lowest.keys()
    for library in bounds.keys() - UNTESTED:
        assert Version(bounds[library]) == Version(lowest[library]), library


def test_the_pinned_versions_are_not_below_the_lower_bounds() -> None:
    pinned = pins("constraints.txt")
    for library, bound in lower_bounds().items():
        assert Version(pinned[library]) >= Version(bound), library


def test_the_hooks_have_the_versions_of_the_environment() -> None:
    configuration = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    revisions = {hook["repo"]: hook.get("rev", "") for hook in configuration["repos"]}
    pinned = pins("constraints.txt")
    for repository, library in {
        "https://github.com/astral-sh/ruff-pre-commit": "ruff",
        "https://github.com/codespell-project/codespell": "codespell",
        "https://github.com/zizmorcore/zizmor-pre-commit": "zizmor",
    }.items():
        assert revisions[repository] == f"v{pinned[library]}"


def test_the_version_is_the_same_wherever_it_is_repeated() -> None:
    version = METADATA["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    image = (ROOT / "docker/Dockerfile").read_text()
    assert citation["version"] == version
    assert dopt.__version__ == version
    assert re.findall(r"^ARG VERSION=(.*)$", image, flags=re.MULTILINE) == [version]


def test_the_changelog_has_a_section_for_the_version() -> None:
    sections = re.findall(
        r"^## (\S+)(?: - (\S+))?$", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE
    )
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (METADATA["version"], str(citation["date-released"])) in sections


def test_no_command_for_pip_names_the_project_that_has_the_name_of_the_import() -> None:
    """Not in a message, nor on a page, nor in a file for machines."""
    assert METADATA["name"] == DISTRIBUTION
    assert install_command("serve") == "pip install 'dopt-exploration[serve]'"
    by_pip = r"(pip|uv)[^\n]* (install|add|download)[^\n]*[ '\"]dopt\b(?!-)"
    foreign = re.compile(rf"\bdopt\[[a-z]|{by_pip}")
    files = [path for path in (*ROOT.glob("*"), ROOT / "docker/Dockerfile") if path.is_file()]
    for folder in FOLDERS:
        files += [path for path in (ROOT / folder).rglob("*") if path.suffix in WRITTEN]
    assert len(files) > 300
    assert not [path for path in files if foreign.search(path.read_text(errors="replace"))]


def test_debian_s_python_can_install_what_is_pinned() -> None:
    """A library may ask for a later bugfix of Python 3.11 than Debian 12 has."""
    pinned = re.findall(r"^([\w.-]+)==", (ROOT / "constraints.txt").read_text(), flags=re.MULTILINE)
    asked = {}
    for name in pinned:
        with contextlib.suppress(metadata.PackageNotFoundError):  # of an extra that is left out
            asked[name] = str(metadata.metadata(name).json.get("requires_python", ""))
    assert len(asked) > 100
    assert not {name for name, versions in asked.items() if "3.11.2" not in SpecifierSet(versions)}
