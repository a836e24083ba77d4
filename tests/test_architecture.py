"""Who may import what: the layers, read from the imports themselves."""

from __future__ import annotations

import ast
import functools
import json
import subprocess
import sys
from pathlib import Path

import pytest

from dopt.kernel.cache import COMPILED_SOURCES

ROOT = Path(__file__).parents[1]
PACKAGES = ("dopt", "orchestrate", "analysis")
EFFECTS = {"hydra", "omegaconf", "ray", "sqlalchemy", "psycopg", "matplotlib"}
ONLY_IN = {
    "hydra": ("orchestrate/launch.py", "orchestrate/hydra_plugins/"),
    "ray": ("orchestrate/executors/ray",),
    "sqlalchemy": ("orchestrate/store/",),
    "psycopg": ("orchestrate/store/",),
    "torch": ("dopt/reference/", "orchestrate/executors/lockstep.py"),
    "numba": ("dopt/kernel/",),
    "gymnasium": ("dopt/gymnasium/",),
    "matplotlib": ("analysis/",),
    "starlette": ("analysis/serve/",),
    "uvicorn": ("analysis/serve/",),
    "jinja2": ("analysis/serve/",),
}


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


def importers(module: str) -> list[str]:
    """Return the files of the packages that import a top-level module."""
    return [
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in sources(package)
        if any(name.split(".")[0] == module for name in imports(path))
    ]


def loaded_by(module: str) -> set[str]:
    """Return the top-level modules that are loaded once ``module`` is, in a fresh process."""
    program = f"import json, sys, {module}; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return {name.split(".")[0] for name in json.loads(done.stdout)}


def test_the_science_knows_no_effects() -> None:
    for path in sources("dopt"):
        tops = {name.split(".")[0] for name in imports(path)}
        assert not tops & (EFFECTS | {"orchestrate", "analysis", "pandas"}), path


def test_the_analysis_reads_through_the_store_alone() -> None:
    shared = ("orchestrate.store", "orchestrate.usage")
    for path in sources("analysis"):
        names = imports(path)
        assert not {name.split(".")[0] for name in names} & {"torch", "ray", "hydra", "numba"}, path
        own = {name for name in names if name.split(".")[0] == "orchestrate"}
        assert all(name.startswith(shared) for name in own), path


def test_what_is_compiled_is_made_of_sources_that_name_its_cache() -> None:
    """A change anywhere else would leave stale machine code where the launcher finds it."""
    folders = tuple(f"dopt.{folder}" for folder in COMPILED_SOURCES)
    for path in sources("dopt/kernel"):
        names = imports(path)
        if names & {"dopt.kernel.compiler"} and path.name != "equations.py":
            own = {name for name in names if name.startswith("dopt.")}
            assert all(name.startswith(folders) for name in own), path


def test_nothing_imports_the_analysis_but_itself() -> None:
    assert all(path.startswith("analysis/") for path in importers("analysis"))


@pytest.mark.parametrize("module", ONLY_IN)
def test_a_library_is_seen_by_one_layer(module: str) -> None:
    assert importers(module)
    for path in importers(module):
        assert path.startswith(ONLY_IN[module]), f"{path} imports {module}"


@pytest.mark.parametrize(
    "folder", ["systems", "models", "policies", "learning", "planning", "control"]
)
def test_what_a_trial_is_does_not_depend_on_how_it_is_run(folder: str) -> None:
    for path in sources(f"dopt/{folder}"):
        for name in imports(path):
            assert not name.startswith(("dopt.kernel", "dopt.reference", "dopt.exploration")), path


def test_a_specification_loads_numpy_and_nothing_heavier() -> None:
    third_party = loaded_by("dopt.spec") - set(sys.stdlib_module_names)
    assert {name for name in third_party if not name.startswith("_")} <= {"dopt", "numpy"}


def test_a_trial_in_the_kernel_needs_no_torch() -> None:
    assert "torch" not in loaded_by("dopt.exploration, dopt.kernel.run")


def test_the_read_side_loads_neither_torch_nor_ray_nor_hydra() -> None:
    loaded = loaded_by("analysis.reading")
    assert not loaded & {"torch", "ray", "hydra", "numba"}


def test_every_package_is_typed_and_described() -> None:
    for package in PACKAGES:
        for path in sources(package):
            tree = ast.parse(path.read_text())
            assert ast.get_docstring(tree) or not tree.body, f"{path} says nothing of itself"
