"""Compilation without machine code of callees."""

from __future__ import annotations

import numpy as np
import pytest
from numba.core.codegen import CPUCodeLibrary
from numba.core.cpu import CPUContext

from dopt.kernel.compiler import compiled
from dopt.kernel.outermost_code import leave_callees_out
from dopt.types import CompiledFunction, Vector


def has_code(function: CompiledFunction) -> bool:
    """Tell whether the compiler's back end has made code of the one signature of a function."""
    [result] = function.overloads.values()
    return result.library._compiled_object is not None


def test_callers_give_their_numbers_and_callees_have_no_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for owner, name in (
        (CPUCodeLibrary, "_finalize_final_module"),
        (CPUContext, "get_executable"),
    ):
        monkeypatch.setattr(owner, name, getattr(owner, name))  # as they are, after this test

    @compiled
    def total(values: Vector) -> float:
        result = 0.0
        for value in values:
            if value < 0.0:
                raise ValueError("a value is below zero")
            result += value
        return result

    @compiled
    def mean(values: Vector) -> float:
        return total(values) / len(values)

    leave_callees_out()
    assert mean(np.array([1.0, 2.0, 6.0])) == 3.0
    with pytest.raises(ValueError, match="below zero"):
        mean(np.array([1.0, -2.0]))
    assert has_code(mean)
    assert not has_code(total)
