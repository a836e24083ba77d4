"""Machine code of a user's own functions: kept for the next process while nothing has changed."""

from __future__ import annotations

import os
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from dopt.kernel.compiler import content_digest
from tests.paths import ROOT

MODULE = """
import math
import numpy as np
from dopt.kernel.linear_algebra import inner

FACTOR = {factor}
TABLE = np.array([1.0, 2.0])

def half(x):
    return FACTOR * x

def plan(x, out):
    out[0] = half(x) + TABLE[1] + math.sqrt(4.0) + 0.0 * inner(out, out)
"""
PROGRAM = """
import numpy as np, sys
from numba import float64, void
from dopt.kernel.compiler import compiled_own
from own import plan
compiled = compiled_own(plan, void(float64, float64[::1]))
out = np.zeros(1)
compiled(10.0, out)
print(len(compiled.stats.cache_hits), out[0])
"""


def answer(folder: Path, factor: float) -> tuple[int, float]:
    """Return how often a process found the code in the cache, and what the code returned."""
    (folder / "own.py").write_text(MODULE.format(factor=factor))
    path = os.pathsep.join([str(ROOT), str(folder)])
    done = subprocess.run(
        [sys.executable, "-B", "-c", PROGRAM],
        env={**os.environ, "PYTHONPATH": path, "DOPT_CACHE": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    hits, value = done.stdout.split()
    return int(hits), float(value)


def test_a_process_finds_what_another_compiled_until_the_file_changes(tmp_path: Path) -> None:
    assert answer(tmp_path, 0.5) == (0, 9.0)
    assert answer(tmp_path, 0.5) == (1, 9.0)
    assert answer(tmp_path, 2.0) == (0, 24.0)
    assert answer(tmp_path, 0.5) == (1, 9.0)


def function_of(folder: Path, **values: object) -> types.FunctionType:
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
    usual = content_digest(function_of(tmp_path))
    assert usual is not None
    assert content_digest(function_of(tmp_path)) == usual
    other = content_digest(function_of(tmp_path, FACTOR=value))
    assert other not in (None, usual)


def test_what_cannot_be_told_is_not_kept(tmp_path: Path) -> None:
    from tests.dopt import trials

    for value in ([1.0], {"a": 1}, trials, trials.trial, object()):
        assert content_digest(function_of(tmp_path, FACTOR=value)) is None


def test_a_function_without_a_file_is_not_kept() -> None:
    names: dict[str, types.FunctionType] = {}
    exec("def plan(x, out):\n    out[0] = x\n", names)
    assert content_digest(names["plan"]) is None
