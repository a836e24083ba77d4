"""Compiled equations of a system: its own numbers, under symbols that no other system has."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from dopt.kernel import cache
from dopt.kernel.equations import compiled_equations
from dopt.systems import SYSTEMS, Chain, Pendulum, System
from tests.paths import ROOT


@pytest.mark.parametrize("name", SYSTEMS)
def test_compiled_equations_are_those_of_the_system(name: str) -> None:
    system, rng = SYSTEMS[name](), np.random.default_rng(0)
    equations, p = compiled_equations(system), np.array(SYSTEMS[name]().parameters)
    x, u = rng.standard_normal(system.n_states), rng.standard_normal(system.n_inputs)
    known, learned = np.empty(system.n_states), np.empty(system.n_learned)
    equations.known(x, u, p, known)
    point = system.points(x[None], u[None])[0]
    equations.accelerations(point, p, learned)
    assert known == pytest.approx(np.array(system.known(tuple(x), tuple(u), system.parameters)))
    assert learned == pytest.approx(system.learned(x[None], inputs=u[None])[0], rel=1e-12)
    z, slopes = point + 1e-30j * rng.standard_normal(len(point)), np.empty(len(learned), complex)
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
        "import os, sys, numpy as np\n"
        "from dopt.kernel.equations import compiled_equations\n"
        "from dopt.systems import SYSTEMS\n"
        "def check(names):\n"
        "    systems = [SYSTEMS[name]() for name in names]\n"
        "    functions = [compiled_equations(system).known for system in systems]\n"
        "    for system, known in zip(systems, functions):\n"
        "        x, u = np.arange(1.0, 1 + system.n_states), np.ones(system.n_inputs)\n"
        "        out, p = np.empty(system.n_states), system.parameters\n"
        "        known(x, u, np.array(p), out)\n"
        "        assert np.allclose(out, system.known(tuple(x), tuple(u), p)), system.name\n"
        "for words in sys.argv[1:]:\n"  # each in a process that has compiled nothing
        "    child = os.fork()\n"
        "    if not child:\n"
        "        check(words.split())\n"
        "        os._exit(0)\n"
        "    assert os.waitpid(child, 0)[1] == 0, words\n"
    )
    environment = os.environ | {"DOPT_CACHE": str(tmp_path)}
    names = ("pendulum", "cartpole", "cartpole pendulum", "pendulum cartpole")
    command = [sys.executable, "-c", program, *names]
    subprocess.run(command, check=True, env=environment, cwd=ROOT)
