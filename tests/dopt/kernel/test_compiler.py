"""Compiled functions in the cache: one writer, digests, users' code, the plain mode."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from dopt.algorithm import Score
from dopt.errors import SpecificationError
from dopt.fields import LEARN_IN_NUMPY, PLAN_IN_NUMPY
from dopt.kernel import cache, pointers, warm_up
from dopt.kernel.cache import one_compiler_at_a_time
from dopt.kernel.compiler import content_digest
from dopt.kernel.equations import name_of_equations
from dopt.kernel.from_spec import KINDS, network_of
from dopt.kernel.information import FORMS
from dopt.kernel.pointers import function_of
from dopt.kernel.run import trial_in_kernel
from dopt.kernel.warming import choices, kernel_parts, needed_parts
from dopt.learning import LEARNERS
from dopt.learning.base import Learner
from dopt.models import RFF
from dopt.policies import POLICIES, Search
from dopt.policies.base import ClosedLoop
from dopt.policies.search import SCORES, score_code
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.dopt.trials import trial
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS


def printed(program: str, *words: str, folder: Path = ROOT, **environment: str) -> str:
    """Return what a program prints that runs in a process of its own, which may not fail."""
    command = [sys.executable, "-c", program, *words]
    given = os.environ | environment
    done = subprocess.run(
        command, env=given, cwd=folder, stdout=subprocess.PIPE, text=True, check=True
    )
    return done.stdout


def cache_without(folder: Path, *names: str) -> str:
    """Return a folder in which the cache is the warm one without some files."""
    warm_up()
    copy, without = folder / "dopt" / cache.CACHE_FOLDER.name, shutil.ignore_patterns(*names)
    shutil.copytree(cache.CACHE_FOLDER, copy, copy_function=os.symlink, ignore=without)
    return str(folder)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(cache, "CACHE_FOLDER", tmp_path)
    return tmp_path


def test_a_second_compiler_of_a_function_waits_for_the_first(folder: Path) -> None:  # noqa: ARG001
    first_ended, second_entered = threading.Event(), threading.Event()
    after_first = []

    def second() -> None:
        with one_compiler_at_a_time("loop-second"):
            after_first.append(first_ended.is_set())
            second_entered.set()

    with one_compiler_at_a_time("loop-first"):
        thread = threading.Thread(target=second)
        thread.start()
        assert not second_entered.wait(0.2)
        with one_compiler_at_a_time("equations"):
            first_ended.set()
    thread.join(PATIENCE_SECONDS)
    assert after_first == [True]


def test_what_is_in_the_cache_is_read_by_all_at_once_and_what_failed_is_not(folder: Path) -> None:
    with pytest.raises(KeyError), one_compiler_at_a_time("loop"):
        raise KeyError
    assert not (folder / "loop.complete").exists()
    with one_compiler_at_a_time("loop"):
        pass
    with one_compiler_at_a_time("other"), one_compiler_at_a_time("loop"):
        assert (folder / "loop.complete").exists()


def test_a_warm_cache_is_seen_without_the_compiler_and_a_trial_runs_without_its_rules() -> None:
    """Numba would load the rules first, for a tenth of a second in every process."""
    warm_up()
    printed(
        "import sys; from dopt.kernel import warm_up; warm_up(); "
        "assert 'numba' not in sys.modules; from dopt import TrialSpec, run_trial; "
        "run_trial(TrialSpec.from_names('pendulum', 'd_optimal')); "
        "assert not {'numba.np.arraymath', 'numba.typed.typeddict'} & {*sys.modules}"
    )


def test_everything_is_what_any_shipped_choice_calls() -> None:
    """Beside them stand the functions that call users' parts in numpy."""
    chosen = choices(everything=True)
    plans = {one.kernel_function for one in POLICIES.values() if one.compiled}
    learns = {one.kernel_function for one in LEARNERS.values() if one.compiled}
    assert plans | {PLAN_IN_NUMPY} == set(chosen.plans)
    assert learns | {LEARN_IN_NUMPY} == set(chosen.learns)
    assert chosen.forms == FORMS
    few = choices(everything=False)
    assert set(few.plans) < set(chosen.plans)


def test_a_trial_loads_what_other_processes_compile(tmp_path: Path) -> None:
    """Where a trial compiles a part itself, its numbers can differ from later trials."""
    program = """
from dopt.kernel.cache import compile_missing, missing
from dopt.kernel.information import add_nothing
from dopt.kernel.pointers import compile_form
from dopt.kernel.run import KernelTrial
from dopt.spec.trial import TrialSpec
part = "dopt.kernel.information.add_nothing"
assert missing([part]) == [part]
compile_missing([part])
trial = KernelTrial(TrialSpec.from_names("pendulum", "random")).trial
compile_form(trial, "add_rows", add_nothing)
print(sum(add_nothing.stats.cache_hits.values()), sum(add_nothing.stats.cache_misses.values()))
"""
    assert printed(program, DOPT_CACHE=cache_without(tmp_path, "*add_nothing*")) == "1 0\n"


GRID = {
    "paper": [("pendulum", policy) for policy in ("d_optimal", "random", "periodic", "uniform")],
    "search": [("cartpole", "lookahead"), ("arm", "icem")],
    "numpy": [("pendulum", "max")],
    "measured": [
        ({"name": "pendulum", "measured_states": [0], "measurement_noise": [0.01]}, "random")
    ],
}


@pytest.mark.parametrize("name", GRID)
def test_a_grid_compiles_what_its_trials_ask_for(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A part that were missing would be compiled while the workers wait for it."""
    specs = [TrialSpec.from_names(system, policy) for system, policy in GRID[name]]
    asked: list[str] = []
    monkeypatch.setattr(pointers, "compile_missing", asked.extend)
    monkeypatch.setattr(pointers, "_trials", {})
    for spec in specs:
        trial_in_kernel(spec).advance(1)
    systems = {name_of_equations(spec.system) for spec in specs}
    assert {*needed_parts(spec.config for spec in specs)} == {*asked} | systems
    assert {*asked} <= {*kernel_parts(everything=True)}


def test_a_second_grid_of_the_same_kinds_is_seen_without_the_compiler(tmp_path: Path) -> None:
    program = """
import sys
from dopt.kernel import compiling
from dopt.spec.trial import TrialSpec
system = {"name": "mass_spring", "horizon": int(sys.argv[1])}
with compiling([TrialSpec.from_names(system, "random").config]):
    print("numba" in sys.modules)
"""
    folder = cache_without(tmp_path, "kinds-*")
    answers = [printed(program, horizon, DOPT_CACHE=folder) for horizon in ("100", "200")]
    assert answers == ["True\n", "False\n"]


def test_another_checkout_finds_what_is_compiled(tmp_path: Path) -> None:
    """The same sources in another folder: nothing is compiled, and the numbers are the same."""
    program = """
import numpy as np
from dopt.kernel.equations import compiled_equations
from dopt.systems import SYSTEMS
function = compiled_equations(SYSTEMS["pendulum"]()).accelerations
out = np.empty(1)
function(np.ones(2), np.array(SYSTEMS["pendulum"]().parameters), out)
print(sum(function.stats.cache_misses.values()), out[0].hex())
"""
    shutil.copytree(ROOT / "dopt", tmp_path / "elsewhere/dopt")
    folder = str(tmp_path / "cache")
    (missed, number), (again, same) = (
        printed(program, folder=one, DOPT_CACHE=folder, PYTHONPATH=str(one)).split()
        for one in (ROOT, tmp_path / "elsewhere")
    )
    assert (missed, again) == ("1", "0")
    assert number == same


def test_a_function_compiled_for_another_or_called_with_one_is_not_stored(tmp_path: Path) -> None:
    """Whoever opened the second would compile its argument, without what its module prepares."""
    (tmp_path / "pair.py").write_text(
        """
from pathlib import Path
from dopt.kernel import compiler
compiler._PACKAGE = Path(__file__).parent
from dopt.kernel.compiler import compiled
@compiled
def inner(x):
    return x + 1.0
@compiled
def outer(x):
    return 2.0 * inner(x)
@compiled
def applied(functions, x):
    return 2.0 * functions[0](x)
assert outer(1.0) == applied((inner,), 1.0) == 4.0
"""
    )
    printed("import pair", folder=tmp_path, DOPT_CACHE=str(tmp_path / "cache"))
    found = [path.name.partition("-")[0] for path in tmp_path.rglob("*.nbi")]
    assert found == ["pair.outer"]


def test_a_cache_that_cannot_be_written_is_one_folder_for_all_processes(tmp_path: Path) -> None:
    """And is gone with the process that made it."""
    program = """
import subprocess, sys
from dopt.kernel.cache import CACHE_FOLDER
print(CACHE_FOLDER, flush=True)
if len(sys.argv) < 3:
    subprocess.run([sys.executable, "-c", sys.argv[1], sys.argv[1], "child"], check=True)
print(CACHE_FOLDER.is_dir())
"""
    (tmp_path / "file").touch()
    said = printed(program, program, DOPT_CACHE=str(tmp_path / "file" / "cache"))
    made, used, there, still_there = said.split()
    assert (made, there, still_there) == (used, "True", "True")
    assert not Path(made).exists()


MODULE = """
import math
import numpy as np
from dopt.kernel.vectors import inner

FACTOR = {factor}
TABLE = np.array([1.0, 2.0])

def half(x):
    return FACTOR * x

def plan(x, out):
    out[0] = half(x) + TABLE[1] + math.sqrt(4.0) + 0.0 * inner(out, out)
"""


def function_with(folder: Path, **values: object) -> types.FunctionType:
    """Return the plan of a module in which names have other values than its file says."""
    path = folder / "own.py"
    path.write_text(MODULE.format(factor=0.5))
    module = types.ModuleType("own")
    exec(compile(path.read_text(), str(path), "exec"), module.__dict__)
    module.__dict__.update(values)
    function: types.FunctionType = module.plan
    return function


@pytest.mark.parametrize("value", [0.25, True, (1.0, 2.0), "text", np.array([3.0])])
def test_a_constant_from_elsewhere_is_part_of_the_content(tmp_path: Path, value: object) -> None:
    usual = content_digest(function_with(tmp_path))
    assert usual is not None
    assert content_digest(function_with(tmp_path)) == usual
    other = content_digest(function_with(tmp_path, FACTOR=value))
    assert other not in (None, usual)


def test_what_cannot_be_told_or_has_no_file_is_not_kept(tmp_path: Path) -> None:
    from tests.dopt import trials

    for value in ([1.0], {"a": 1}, trials, trials.trial, object()):
        assert content_digest(function_with(tmp_path, FACTOR=value)) is None
    names: dict[str, types.FunctionType] = {}
    exec("def plan(x, out):\n    out[0] = x\n", names)
    assert content_digest(names["plan"]) is None


@dataclass(frozen=True, kw_only=True)
class NewPolicy(ClosedLoop):
    name: ClassVar[str] = "new"
    compiled: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class NewLearner(Learner):
    name: ClassVar[str] = "new"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.learners.forgotten"


@pytest.mark.parametrize("part", [NewPolicy(), NewLearner()])
def test_a_kernel_function_that_does_not_exist_is_named(part: ClosedLoop | Learner) -> None:
    with pytest.raises(SpecificationError, match="'new' names the kernel function"):
        function_of(part, None)


def test_a_model_that_the_kernel_does_not_know_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(KINDS, RFF)
    with pytest.raises(SpecificationError, match="model 'rff' says that it is compiled"):
        network_of(SYSTEMS["pendulum"](), RFF())


def test_every_score_has_a_name_and_each_policy_that_searches_one_of_them() -> None:
    assert list(SCORES.values()) == list(Score)
    searching = [cls() for cls in POLICIES.values() if issubclass(cls, Search)]
    assert {score_code(policy) for policy in searching} >= set(Score) - {Score.JOINT}


NETWORK = {"name": "mlp", "width": 3, "depth": 1}
STAR = {"name": "grey_box", "unknown": ["center_x", "center_y"], "initial": [0.1, 0.1]}
ENCODERS = {"measured_states": [0, 2], "measurement_noise": [0.01, 0.01], "horizon": 6}
TRIALS = [
    trial("pendulum", "d_optimal", 1, env={"horizon": 6}, model=NETWORK),
    trial("moving_star", "lookahead", 1, env={"horizon": 12}, model=STAR),
    trial("arm", "random", 1, env=ENCODERS, model=NETWORK, learner={"name": "joint_ekf"}),
]
PLAIN_PROGRAM = """
import json, sys
from numba.core.dispatcher import Dispatcher
from dopt.kernel import loop
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
assert not isinstance(loop.advance, Dispatcher)
found = []
for mapping in json.loads(sys.argv[1]):
    result = run_trial(TrialSpec.from_mapping(mapping))
    found.append({name: getattr(result, name).tolist() for name in sys.argv[2:]})
print(json.dumps(found))
"""
EXACT, SINGLE = ("states", "inputs", "parameters"), ("loss", "reachable_loss")
"""What is computed in double precision, and losses, which may be judged in single precision."""


@pytest.fixture(scope="module")
def plain() -> list[dict[str, Any]]:
    given = json.dumps([spec.to_mapping() for spec in TRIALS])
    found: list[dict[str, Any]] = json.loads(
        printed(PLAIN_PROGRAM, given, *EXACT, *SINGLE, DOPT_PLAIN="1")
    )
    return found


@pytest.mark.parametrize("index", range(len(TRIALS)))
def test_both_give_the_same_trial(index: int, plain: list[dict[str, Any]]) -> None:
    spec: TrialSpec = TRIALS[index]
    compiled, found = run_trial(spec), plain[index]
    for name in EXACT:
        values = getattr(compiled, name)
        scale = np.abs(values).max()
        assert np.array(found[name]) == pytest.approx(values, rel=0.0, abs=1e-12 * scale), name
    for name in SINGLE:
        assert np.array(found[name]) == pytest.approx(getattr(compiled, name), rel=1e-5), name
