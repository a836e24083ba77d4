"""Rules of the architecture, read from imports and docstrings; tools of the tests."""

from __future__ import annotations

import ast
import functools
import re
import sys
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from dopt.kernel.cache import COMPILED_SOURCES
from tests.measure_house import code_lines
from tests.paths import ROOT, loaded_by

PACKAGES = ("dopt", "orchestrate", "analysis")
EFFECTS = {"hydra", "omegaconf", "ray", "sqlalchemy", "psycopg", "matplotlib"}
SAVES = {"orchestrate.runner.saving"}
"""Imports from other packages by the saves of an exploration."""

ONLY_IN = {
    "hydra": ("orchestrate/config/",),
    "omegaconf": ("orchestrate/config/", "analysis/log_report.py"),
    "ray": ("orchestrate/executors/ray/",),
    "sqlalchemy": ("orchestrate/store/",),
    "psycopg": ("orchestrate/store/",),
    "torch": ("dopt/reference/", "dopt/fitting/export.py", "orchestrate/executors/lockstep.py"),
    "numba": ("dopt/kernel/", "dopt/fitting/"),
    "gymnasium": ("dopt/gymnasium.py", "dopt/fitting/export.py"),
    "mujoco": ("dopt/systems/mujoco.py", "dopt/robots/"),
    "matplotlib": (
        "analysis/figures/",
        "analysis/outputs.py",
        "analysis/film.py",
        "orchestrate/commands/design.py",
    ),
    "starlette": ("analysis/serve/",),
    "uvicorn": ("analysis/serve/",),
    "jinja2": ("analysis/serve/",),
}

NUMBERS = ("analysis/data", "analysis/stats", "analysis/tables")
"""Parts of the analysis that compute or select numbers and draw nothing."""

BASE = {"errors", "records", "program"}
ORCHESTRATE_IMPORTS = {
    "errors": set(),
    "records": set(),
    "fingerprint": set(),
    "program": {"errors"},
    "config": BASE,
    "executors": BASE | {"config", "fingerprint"},
    "store": {"errors", "records"},
    "runner": BASE | {"config", "executors", "fingerprint", "store"},
    "commands": BASE | {"runner", "store"},
    "launch": BASE | {"config", "executors", "runner"},
    "__main__": BASE | {"commands"},
}
"""Folders and modules of orchestrate that each one may import."""

QUESTION_WORDS = ("What", "How", "Where", "Whether", "Who", "Whose", "When", "Why")


def sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@functools.cache
def imports(path: Path) -> frozenset[str]:
    """Return every module that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names.add(str(node.module))
    return frozenset(names)


def module_name(path: Path) -> str:
    """Return the dotted name of a file; a package is the name of its folder."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def own_modules() -> frozenset[str]:
    """Return all modules of the packages."""
    return frozenset(module_name(path) for package in PACKAGES for path in sources(package))


def own_imports(path: Path) -> Iterator[str]:
    """Yield the modules of the packages that a file imports, also only to check types."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in own_modules())
        elif isinstance(node, ast.ImportFrom) and node.module in own_modules():
            names = (f"{node.module}.{alias.name}" for alias in node.names)
            yield from (name if name in own_modules() else str(node.module) for name in names)


def packages_of(module: str) -> set[str]:
    """Return the packages that a module lies in, which are imported before it."""
    parts = module.split(".")
    return {".".join(parts[:end]) for end in range(1, len(parts))}


def circle(arrows: Iterable[tuple[str, str]]) -> list[str]:
    """Return a circle of the graph, empty if there is none."""
    graph: dict[str, set[str]] = {}
    for source, target in arrows:
        if source != target:
            graph.setdefault(source, set()).add(target)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def importers(module: str) -> list[str]:
    """Return the files of the packages that import a top-level module."""
    return [
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in sources(package)
        if any(name.split(".")[0] == module for name in imports(path))
    ]


def tops_loaded_by(program: str) -> set[str]:
    """Return the top-level modules that are loaded once a program has run."""
    return {name.split(".")[0] for name in loaded_by(program)}


def test_the_science_knows_no_effects() -> None:
    for path in sources("dopt"):
        own = SAVES if path == ROOT / "dopt/explorer/saving.py" else set()
        tops = {name.split(".")[0] for name in imports(path) - own}
        assert not tops & (EFFECTS | {"orchestrate", "analysis", "pandas"}), path


def test_what_saves_an_exploration_is_loaded_by_the_first_save() -> None:
    assert imports(ROOT / "dopt/explorer/saving.py") >= SAVES
    assert not tops_loaded_by("import dopt.explorer.saving") & (EFFECTS | {"orchestrate"})


def test_the_analysis_reads_through_the_store_alone() -> None:
    parts = ("store", "errors", "program")
    shared = tuple(f"orchestrate.{part}" for part in parts)
    errors = "from orchestrate.errors import "
    for path in sources("analysis"):
        names = imports(path)
        assert not {name.split(".")[0] for name in names} & {"torch", "ray", "hydra", "numba"}, path
        own = {name for name in names if name.split(".")[0] == "orchestrate"}
        assert all(name.startswith(shared) for name in own), path
        lines = [line for line in path.read_text().splitlines() if line.startswith(errors)]
        files = {name for line in lines for name in line.removeprefix(errors).split(", ")}
        assert files <= {"make_folder", "whole"}, path  # its other errors come from the store


def test_what_is_compiled_is_made_of_sources_that_name_its_cache() -> None:
    """A change anywhere else would leave stale machine code where the launcher finds it."""
    folders = tuple(f"dopt.{source.removesuffix('.py')}" for source in COMPILED_SOURCES)
    annotations = "dopt.types"  # which numba never reads
    for path in sources("dopt/kernel"):
        text = path.read_text(encoding="utf-8")
        compiles = re.search("^@(compiled|called_from_python)$", text, re.M)
        if compiles and path.name != "compiler.py":
            own = {name for name in imports(path) if name.startswith("dopt.")}
            assert all(name.startswith((*folders, annotations)) for name in own), path


def test_nothing_imports_a_study_or_the_analysis_but_itself() -> None:
    assert all(path.startswith("analysis/") for path in importers("analysis"))
    assert not importers("studies")


@pytest.mark.parametrize("module", ONLY_IN)
def test_a_library_is_seen_by_one_layer(module: str) -> None:
    assert importers(module)
    for path in importers(module):
        assert path.startswith(ONLY_IN[module]), f"{path} imports {module}"


@pytest.mark.parametrize("folder", ["systems", "models", "policies", "learning", "control"])
def test_what_a_trial_is_does_not_depend_on_how_it_is_run(folder: str) -> None:
    for path in sources(f"dopt/{folder}"):
        for name in imports(path):
            assert not name.startswith(("dopt.kernel", "dopt.reference", "dopt.run")), path


@pytest.mark.parametrize("package", PACKAGES)
def test_no_import_circle_even_for_types(package: str) -> None:
    """Then every module can be the first of the package that a program imports."""
    arrows = (
        (module_name(path), name)
        for path in sources(package)
        for imported in own_imports(path)
        for name in (imported, *packages_of(imported) - packages_of(module_name(path)))
    )
    assert not circle(arrows)


@pytest.mark.parametrize("part", ORCHESTRATE_IMPORTS)
def test_orchestrate_imports_downwards_only(part: str) -> None:
    folder = ROOT / "orchestrate" / part
    for path in sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]:
        parts = {
            name.split(".")[1] for name in own_imports(path) if name.startswith("orchestrate.")
        }
        assert parts <= ORCHESTRATE_IMPORTS[part] | {part}, path


def test_every_part_of_orchestrate_has_its_place() -> None:
    found = {path.relative_to(ROOT / "orchestrate").parts[0] for path in sources("orchestrate")}
    assert {name.removesuffix(".py") for name in found} - {"__init__"} == set(ORCHESTRATE_IMPORTS)
    arrows = ((part, name) for part, names in ORCHESTRATE_IMPORTS.items() for name in names)
    assert not circle(arrows)


def test_numbers_load_neither_matplotlib_nor_what_runs_trials() -> None:
    paths = (ROOT / part for part in NUMBERS)
    modules = [module_name(path) for folder in paths for path in sorted(folder.rglob("*.py"))]
    assert len(modules) > 10
    modules += ["analysis.report", "analysis.outputs", "analysis.cli"]
    heavy = {"matplotlib", "torch", "ray", "hydra", "numba"}
    assert not tops_loaded_by(f"import {', '.join(modules)}") & heavy


def test_a_specification_loads_numpy_alone_and_the_store_five_modules_of_the_science() -> None:
    always = tops_loaded_by("")  # such as Debian's sitecustomize
    modules = ", ".join(module_name(path) for path in sources("dopt/spec"))
    third_party = tops_loaded_by(f"import {modules}") - always - set(sys.stdlib_module_names)
    assert {name for name in third_party if not name.startswith("_")} <= {"dopt", "numpy"}
    names = loaded_by("import orchestrate.store")
    assert len([name for name in names if name.split(".")[0] == "dopt"]) <= 5


@pytest.mark.parametrize("package", PACKAGES)
def test_every_module_says_what_it_is_by_a_noun_phrase(package: str) -> None:
    for path in sources(package):
        tree = ast.parse(path.read_text())
        said = ast.get_docstring(tree) or ""
        assert said or not tree.body, f"{path} says nothing of itself"
        assert said.split(" ")[0] not in QUESTION_WORDS, path


MODULE = '''"""Docstring
of two lines."""

import os
from sys import (
    path,
)

NAMES = (  # two lines, and a comment
    "a")
"""Text below a name."""


def function():
    """Docstring."""
    # A comment.
    text = """one
two"""
    return text
'''


def test_imports_comments_blank_lines_and_docstrings_are_no_code() -> None:
    assert code_lines(MODULE) == 6


@pytest.mark.xdist_group("alone")
def test_a_group_is_known_to_the_scheduler(request: pytest.FixtureRequest) -> None:
    """Where pytest and pytest-xdist do not fit, each worker starts what a group shares."""
    grouped = getattr(request.config.option, "loadgroup", False)
    assert request.node.nodeid.endswith("@alone") == grouped
