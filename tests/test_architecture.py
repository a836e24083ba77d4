"""Rules of the architecture, read from the imports and docstrings of the packages."""

from __future__ import annotations

import ast
import functools
import itertools
import json
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from dopt.kernel.cache import COMPILED_SOURCES
from tests.paths import ROOT, without_coverage

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

NUMBERS = (
    "analysis/data",
    "analysis/stats",
    "analysis/tables",
)
"""Parts of the analysis that compute or select numbers and draw nothing."""

BASE = {"errors", "records", "files", "program"}
ORCHESTRATE_IMPORTS = {
    "errors": set(),
    "records": set(),
    "fingerprint": set(),
    "files": set(),
    "program": {"errors"},
    "config": BASE,
    "executors": BASE | {"config", "fingerprint"},
    "store": {"errors", "records", "files"},
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


def loaded_by(module: str) -> set[str]:
    """Return the top-level modules that are loaded once ``module`` is, in a fresh process."""
    return {name.split(".")[0] for name in all_loaded_by(module)}


def all_loaded_by(module: str) -> list[str]:
    """Return all modules that are loaded once ``module`` is, in a fresh process."""
    program = f"import json, sys, {module}; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env=without_coverage(),
        capture_output=True,
        text=True,
        check=True,
    )
    names: list[str] = json.loads(done.stdout)
    return names


def test_the_science_knows_no_effects() -> None:
    for path in sources("dopt"):
        own = SAVES if path == ROOT / "dopt/explorer/saving.py" else set()
        tops = {name.split(".")[0] for name in imports(path) - own}
        assert not tops & (EFFECTS | {"orchestrate", "analysis", "pandas"}), path


def test_what_saves_an_exploration_is_loaded_by_the_first_save() -> None:
    assert imports(ROOT / "dopt/explorer/saving.py") >= SAVES
    assert not loaded_by("dopt.explorer.saving") & (EFFECTS | {"orchestrate"})


def test_the_analysis_reads_through_the_store_alone() -> None:
    parts = ("store", "files", "program")
    shared = tuple(f"orchestrate.{part}" for part in parts)
    for path in sources("analysis"):
        names = imports(path)
        assert not {name.split(".")[0] for name in names} & {"torch", "ray", "hydra", "numba"}, path
        own = {name for name in names if name.split(".")[0] == "orchestrate"}
        assert all(name.startswith(shared) for name in own), path


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


def test_nothing_imports_the_analysis_but_itself() -> None:
    assert all(path.startswith("analysis/") for path in importers("analysis"))


def test_nothing_imports_a_study() -> None:
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


def test_numbers_load_no_matplotlib() -> None:
    paths = [ROOT / part for part in NUMBERS]
    files = itertools.chain.from_iterable(
        sorted(path.rglob("*.py")) if path.is_dir() else [path] for path in paths if path.exists()
    )
    modules = [module_name(path) for path in files]
    assert len(modules) > 10
    modules += ["analysis.tables.variants", "analysis.tables.rendering", "analysis.report"]
    assert "matplotlib" not in loaded_by(", ".join([*modules, "analysis.outputs", "analysis.cli"]))


def test_a_specification_loads_no_torch() -> None:
    modules = ", ".join(module_name(path) for path in sources("dopt/spec"))
    assert "torch" not in loaded_by(modules)


def test_a_specification_loads_numpy_and_nothing_heavier() -> None:
    always = loaded_by("sys")  # such as Debian's sitecustomize
    third_party = loaded_by("dopt.spec.trial") - always - set(sys.stdlib_module_names)
    assert {name for name in third_party if not name.startswith("_")} <= {"dopt", "numpy"}


def test_a_trial_in_the_kernel_needs_no_torch() -> None:
    assert "torch" not in loaded_by("dopt.run, dopt.kernel.run")


def test_the_read_side_loads_neither_torch_nor_ray_nor_hydra() -> None:
    loaded = loaded_by("analysis.data.samples")
    assert not loaded & {"torch", "ray", "hydra", "numba"}


def test_the_store_loads_at_most_five_modules_of_the_science() -> None:
    names = all_loaded_by("orchestrate.store")
    assert len([name for name in names if name.split(".")[0] == "dopt"]) <= 5


def test_every_package_is_typed_and_described() -> None:
    for package in PACKAGES:
        for path in sources(package):
            tree = ast.parse(path.read_text())
            assert ast.get_docstring(tree) or not tree.body, f"{path} says nothing of itself"


@pytest.mark.parametrize("package", PACKAGES)
def test_a_module_docstring_begins_with_a_noun_phrase(package: str) -> None:
    first_words = {
        module_name(path): (ast.get_docstring(ast.parse(path.read_text())) or "").split(" ")[0]
        for path in sources(package)
    }
    riddles = {name: word for name, word in first_words.items() if word in QUESTION_WORDS}
    assert not riddles
