"""Compilation that neither optimizes callees nor makes machine code of them."""

from __future__ import annotations

import numpy as np
import pytest
from numba.core.codegen import CPUCodeLibrary
from numba.core.cpu import CPUContext

from dopt.kernel import warming
from dopt.kernel.compiler import compiled, contracted
from dopt.kernel.warming import leave_callees_out
from dopt.types import CompiledFunction, Vector


def has_code(function: CompiledFunction) -> bool:
    """Tell whether the compiler's back end has made code of the one signature of a function."""
    [result] = function.overloads.values()
    return result.library._compiled_object is not None


@pytest.fixture
def as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let Numba be as it is when the test has ended."""
    for owner, name in (
        (CPUCodeLibrary, "_optimize_final_module"),
        (CPUCodeLibrary, "_finalize_final_module"),
        (CPUContext, "get_executable"),
    ):
        monkeypatch.setattr(owner, name, getattr(owner, name))


@pytest.mark.usefixtures("as_before")
def test_callers_give_their_numbers_and_callees_have_no_code() -> None:
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


@pytest.mark.usefixtures("as_before")
def test_callees_are_optimized_where_they_may_round_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    optimized: list[str] = []

    def optimize(library: CPUCodeLibrary) -> None:
        optimized.append(library.name)
        whole(library)

    whole = warming._optimize
    monkeypatch.setattr(warming, "_optimize", optimize)

    @compiled
    def first(a: float, b: float, c: float) -> float:
        return a * b + c

    @contracted
    def second(a: float, b: float, c: float) -> float:
        return a * b + c

    @compiled
    def both(a: float, b: float, c: float) -> float:
        return first(a, b, c) + second(a, b, c)

    leave_callees_out()
    assert both(2.0, 3.0, 4.0) == 20.0
    assert [name for name in optimized if "first" in name] == []
    assert len([name for name in optimized if "second" in name]) == 1
    assert len([name for name in optimized if "both" in name]) == 1
