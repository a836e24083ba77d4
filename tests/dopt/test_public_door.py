"""The names that ``import dopt`` offers, and what they load."""

from __future__ import annotations

import ast
import importlib.metadata
import json
import pydoc
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dopt
from analysis.outputs import versions
from dopt.errors import SpecificationError
from orchestrate.runner.saving import launch_record
from tests.paths import ROOT

HEAVY = {"torch", "ray", "numba", "hydra", "sqlalchemy", "matplotlib", "pandas", "scipy"}


def loaded_by(program: str) -> set[str]:
    """Return the top-level modules that a program loads in a fresh process."""
    shown = f"{program}\nimport json, sys; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", shown], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return {name.split(".")[0] for name in json.loads(done.stdout)}


def test_the_import_alone_loads_no_library() -> None:
    assert not loaded_by("import dopt") & (HEAVY | {"numpy"})


def test_a_specification_needs_numpy_alone() -> None:
    program = "import dopt; dopt.TrialSpec.from_names('pendulum', 'd_optimal'); dopt.TrialResult"
    assert not loaded_by(program) & HEAVY


@pytest.mark.parametrize("name", dopt.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert name in dir(dopt)
    assert getattr(dopt, name) is getattr(dopt, name)


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


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'run_trail'"):
        dopt.run_trail  # noqa: B018


def test_help_shows_what_the_names_are() -> None:
    text = pydoc.render_doc(dopt, renderer=pydoc.plaintext)
    for name in ("run_trial", "TrialSpec", "SYSTEMS", "LEARNERS"):
        assert name in text
    assert all(getattr(dopt, name).__doc__ for name in ("run_trial", "TrialSpec", "TrialResult"))


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


def test_a_trial_from_names_is_that_of_its_mapping() -> None:
    spec = dopt.TrialSpec.from_names(
        env={"name": "pendulum", "gamma": 3.0}, policy="random", learner="adam", seed=4
    )
    sections = {
        "env": {"name": "pendulum", "gamma": 3.0},
        "policy": {"name": "random"},
        "model": {"name": "mlp"},
        "learner": {"name": "adam"},
    }
    assert spec == dopt.TrialSpec.from_mapping({**sections, "seed": 4})
    with pytest.raises(SpecificationError, match="did you mean 'pendulum'"):
        dopt.TrialSpec.from_names(env="pendulun", policy="random")


def test_a_trial_runs_from_the_names_alone() -> None:
    env = {"name": "pendulum", "horizon": 20}
    spec = dopt.TrialSpec.from_names(env, "d_optimal")
    result = dopt.run_trial(spec)
    assert isinstance(result, dopt.TrialResult)
    assert result.states.shape == (21, 2)
    error = spec.model.predict(spec.system, result.parameters, spec.system.grid())
    error -= spec.system.learned(spec.system.grid())
    rms = np.sqrt(np.mean(np.sum(error**2, axis=1)))
    assert result.final_loss == pytest.approx(rms, rel=1e-4)


def test_results_compare_by_identity() -> None:
    spec = dopt.TrialSpec.from_names({"name": "pendulum", "horizon": 3}, "random")
    first, second = dopt.run_trial(spec), dopt.run_trial(spec)
    assert first == first
    assert first != second
    assert len({first, second}) == 2
