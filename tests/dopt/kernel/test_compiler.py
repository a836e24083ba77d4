"""The cache of compiled code: one process writes, and no function takes another's place."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import llvmlite.binding
import numpy as np
import pytest

from dopt.kernel import cache, warm_up
from dopt.kernel.cache import one_compiler_at_a_time
from dopt.kernel.compiler import compiled, contracted, squared, vectorized
from dopt.kernel.equations import compiled_equations
from dopt.kernel.from_spec import MODULES
from dopt.kernel.information import absent, fresh, primal_linear
from dopt.kernel.warming import choices
from dopt.learning import LEARNERS
from dopt.policies import POLICIES
from dopt.systems import SYSTEMS, Chain, Pendulum, System
from tests.paths import ROOT


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
    thread.join(10.0)
    assert after_first == [True]


def test_compiling_is_said_at_once(folder: Path, caplog: pytest.LogCaptureFixture) -> None:  # noqa: ARG001
    with one_compiler_at_a_time("loop-1"):
        [record] = caplog.records
    assert record.name == "dopt.kernel"
    assert "compiling the kernel, once per machine" in record.message
    assert "loop" in record.message
    with one_compiler_at_a_time("loop-1"):
        pass
    assert len(caplog.records) == 1


def test_what_is_in_the_cache_is_read_by_all_at_once(folder: Path) -> None:
    with one_compiler_at_a_time("loop"):
        pass
    with one_compiler_at_a_time("other"), one_compiler_at_a_time("loop"):
        assert (folder / "loop.complete").exists()


def test_a_failed_compilation_is_not_taken_for_a_complete_one(folder: Path) -> None:
    with pytest.raises(KeyError), one_compiler_at_a_time("loop"):
        raise KeyError
    assert not (folder / "loop.complete").exists()


@pytest.mark.parametrize("name", SYSTEMS)
def test_compiled_equations_are_those_of_the_system(name: str) -> None:
    system, rng = SYSTEMS[name](), np.random.default_rng(0)
    equations, p = compiled_equations(system), np.array(SYSTEMS[name]().parameters)
    x, u = rng.standard_normal(system.n_states), rng.standard_normal(system.n_inputs)
    known, learned = np.empty(system.n_states), np.empty(system.n_learned)
    equations.known(x, u, p, known)
    equations.accelerations(x, p, learned)
    assert known == pytest.approx(np.array(system.known(tuple(x), tuple(u), system.parameters)))
    assert learned == pytest.approx(system.learned(x[None])[0], rel=1e-12)
    z, slopes = x + 1e-30j * rng.standard_normal(system.n_states), np.empty(len(learned), complex)
    equations.complex_accelerations(z, p + 0j, slopes)
    exact = np.array(system.accelerations(tuple(z), system.parameters))
    assert slopes.imag == pytest.approx(exact.imag, rel=1e-10, abs=1e-42)


@dataclass(frozen=True, kw_only=True)
class Springy(Pendulum):
    """A system that no one has registered."""

    name: ClassVar[str] = "springy"

    @staticmethod
    def accelerations(state: Any, parameters: Any) -> tuple[Any, ...]:
        return (-parameters[2] * state[0] ** 3,)


def test_equations_from_elsewhere_are_compiled_but_not_cached() -> None:
    """Only the sources of the package are part of the name of the cache's folder."""
    equations, out = compiled_equations(Springy()), np.empty(1)
    equations.accelerations(np.array([2.0, 0.0]), np.array(Springy().parameters), out)
    assert out[0] == -80.0
    assert equations.accelerations.stats.cache_path is None
    own = compiled_equations(Pendulum()).accelerations
    assert str(cache.CACHE_FOLDER) in own.stats.cache_path


def symbols(system: System) -> list[str]:
    """Return the symbols of the compiled equations without Numba's number, which starts anew."""
    names = [
        code.fndesc.mangled_name
        for function in compiled_equations(system)
        for code in function.overloads.values()
    ]
    return [re.sub(r"B\d+v\d+B", "", name) for name in names]


def test_no_two_systems_share_a_symbol() -> None:
    """Two that do and come from different processes can be taken for each other: wrong physics."""
    physics = {(cls.known, cls.accelerations): cls() for cls in SYSTEMS.values()}
    different = [*physics.values(), Chain(n_links=2)]
    shipped = [symbol for system in different for symbol in symbols(system)]
    assert len(shipped) == 3 * len(different)
    assert len(set(shipped)) == len(shipped)
    assert not set(symbols(Springy())[1:]) & set(shipped)


def test_systems_cached_by_different_processes_are_not_confused(tmp_path: Path) -> None:
    program = (
        "import sys, numpy as np\n"
        "from dopt.kernel.equations import compiled_equations\n"
        "from dopt.systems import SYSTEMS\n"
        "systems = [SYSTEMS[name]() for name in sys.argv[1:]]\n"
        "functions = [compiled_equations(system).known for system in systems]\n"
        "for system, known in zip(systems, functions):\n"
        "    x, u = np.arange(1.0, 1 + system.n_states), np.ones(system.n_inputs)\n"
        "    out, p = np.empty(system.n_states), system.parameters\n"
        "    known(x, u, np.array(p), out)\n"
        "    assert np.allclose(out, system.known(tuple(x), tuple(u), p)), system.name\n"
    )
    environment = os.environ | {"DOPT_CACHE": str(tmp_path)}
    for names in (["pendulum"], ["cartpole"], ["cartpole", "pendulum"], ["pendulum", "cartpole"]):
        command = [sys.executable, "-c", program, *names]
        subprocess.run(command, check=True, env=environment, cwd=ROOT)


def test_a_warm_cache_is_seen_without_the_compiler() -> None:
    warm_up()
    program = (
        "import sys; from dopt.kernel import warm_up; warm_up(); assert 'numba' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)


def test_everything_is_what_any_shipped_choice_calls() -> None:
    chosen = choices(everything=True)
    assert {one.kernel_function for one in POLICIES.values() if one.compiled} == set(chosen.plans)
    assert {one.kernel_function for one in LEARNERS.values() if one.compiled} == set(chosen.learns)
    assert {*MODULES.values(), primal_linear, absent, fresh} == set(chosen.forms)
    few = choices(everything=False)
    assert set(few.plans) < set(chosen.plans)
    assert few.n_parts() < chosen.n_parts()


def test_code_for_another_processor_is_not_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the processor has the same name and offers less, as in a virtual machine."""

    class Less(dict[str, bool]):
        def flatten(self) -> str:
            return "-avx2"

    here = cache._source_digest()
    monkeypatch.setattr(llvmlite.binding, "get_host_cpu_features", Less)
    assert cache._source_digest() != here


def test_another_checkout_finds_what_is_compiled(tmp_path: Path) -> None:
    """The same sources in another folder: nothing is compiled, and the numbers are the same."""
    program = (
        "import numpy as np\n"
        "from dopt.kernel.equations import compiled_equations\n"
        "from dopt.kernel.tanh import tanh\n"
        "from dopt.systems import SYSTEMS\n"
        "function = compiled_equations(SYSTEMS['pendulum']()).accelerations\n"
        "out = np.empty(1)\n"
        "function(np.ones(2), np.array(SYSTEMS['pendulum']().parameters), out)\n"
        "print(sum(function.stats.cache_misses.values()), out[0].hex())\n"
    )
    shutil.copytree(ROOT / "dopt", tmp_path / "elsewhere/dopt")
    answers = []
    for checkout in (ROOT, tmp_path / "elsewhere"):
        done = subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"DOPT_CACHE": str(tmp_path / "cache"), "PYTHONPATH": str(checkout)},
            cwd=checkout,
            capture_output=True,
            text=True,
            check=True,
        )
        answers.append((done.stdout.split(), "compiling" in done.stderr))
    (first, compiling), (second, again) = answers
    assert (first[0], compiling) == ("1", True)
    assert (second[0], again) == ("0", False)
    assert first[1] == second[1]


def test_a_function_compiled_for_another_is_not_stored(tmp_path: Path) -> None:
    (tmp_path / "pair.py").write_text(
        "from pathlib import Path\n"
        "from dopt.kernel import stored_code\n"
        "stored_code._PACKAGE = Path(__file__).parent\n"
        "from dopt.kernel.compiler import compiled\n"
        "@compiled\n"
        "def inner(x):\n"
        "    return x + 1.0\n"
        "@compiled\n"
        "def outer(x):\n"
        "    return 2.0 * inner(x)\n"
        "assert outer(1.0) == 4.0\n"
    )
    environment = os.environ | {"DOPT_CACHE": str(tmp_path / "cache")}
    subprocess.run([sys.executable, tmp_path / "pair.py"], check=True, env=environment)
    found = [path.name.partition("-")[0] for path in tmp_path.rglob("*.nbi")]
    assert found == ["pair.outer"]


ROUNDED = 1.0 + 2.0**-27
"""A number whose square is not a double: fused, x² - fl(x²) is not zero."""


@pytest.mark.parametrize("liberal", [contracted, vectorized])
def test_rounding_does_not_depend_on_which_function_calls_first(
    liberal: Callable[[Callable[..., float]], Callable[..., float]],
) -> None:
    """Numba compiles a function once, and would hand it the liberties of its first caller."""

    @compiled
    def difference(x: float, z: float) -> float:
        return x * x - z

    @liberal
    def first(x: float, z: float) -> float:
        return difference(x, z)

    assert first(ROUNDED, ROUNDED * ROUNDED) == 0.0
    assert difference(ROUNDED, ROUNDED * ROUNDED) == 0.0


def test_a_square_is_rounded_before_it_enters_a_sum() -> None:
    @contracted
    def with_square(x: float, z: float) -> float:
        return squared(x) - z

    assert with_square(ROUNDED, ROUNDED * ROUNDED) == 0.0


def test_no_function_that_may_fuse_uses_the_operator_of_powers() -> None:
    """It is compiled as a function of its own, with the liberties of whichever uses it first."""
    for path in (ROOT / "dopt" / "kernel").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                names = {d.id for d in node.decorator_list if isinstance(d, ast.Name)}
                if names & {"contracted", "vectorized"}:
                    powers = [n for n in ast.walk(node) if isinstance(n, ast.Pow)]
                    assert not powers, f"{path.name}: {node.name}"
