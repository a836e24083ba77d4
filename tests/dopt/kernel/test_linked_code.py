"""A function that only compiled code calls has no machine code of its own, and nobody notices."""

from __future__ import annotations

from typing import Any

import pytest
from numba import float64, types

from dopt.kernel.compiler import compiled
from dopt.kernel.pointers import pointer
from dopt.types import CompiledFunction


def pair() -> tuple[Any, Any]:
    """Return two new functions, of which the second calls the first."""

    @compiled
    def root(x: float) -> float:
        if x < 0.0:
            raise ValueError("no root of", x)
        return x**0.5

    @compiled
    def twice(x: float) -> float:
        return 2.0 * root(x)

    return root, twice


def test_what_is_compiled_on_the_way_is_only_linked() -> None:
    root, twice = pair()
    assert twice(4.0) == 4.0
    [inner] = root.overloads.values()
    assert inner.library.only_linked
    assert inner.fndesc.llvm_cpython_wrapper_name not in inner.library.get_llvm_str()
    [outer] = twice.overloads.values()
    assert not outer.library.only_linked


def test_python_may_call_it_later() -> None:
    root, twice = pair()
    assert twice(4.0) == 4.0
    assert (root(4.0), root(9.0), root.py_func(9.0)) == (2.0, 3.0, 3.0)
    assert twice(9.0) == 6.0
    assert len(root.overloads) == 1


def test_an_error_below_names_its_value() -> None:
    """The arguments of an exception are found through the environment of the inner function."""
    root, twice = pair()
    with pytest.raises(ValueError, match=r"\('no root of', -4.0\)"):
        twice(-4.0)
    with pytest.raises(ValueError, match=r"\('no root of', -1.0\)"):
        root(-1.0)


def test_a_pointer_to_it_may_be_taken_later() -> None:
    root, twice = pair()
    assert twice(4.0) == 4.0

    @compiled
    def apply(function: CompiledFunction, x: float) -> float:
        return function(x)

    apply.compile((pointer(types.float64(float64)), float64))  # type: ignore[attr-defined]
    apply.disable_compile()  # type: ignore[attr-defined]
    assert apply(root, 16.0) == 4.0
