"""Products whose sums have one order, against dense ones, for this processor and for others."""

from __future__ import annotations

import os
from collections.abc import Callable
from fractions import Fraction

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopt.kernel import vectors
from dopt.kernel.vectors import GROUP, LANES, aligned_zeros, padded
from dopt.types import Array
from tests.paths import printed

SIZES = st.integers(1, 40)
PRECISIONS = st.sampled_from([(np.float64, 1e-13), (np.float32, 1e-5)])


def compiled(routine: Callable[..., object], n_arguments: int) -> Callable[..., object]:
    """Return a routine as Python can call it."""
    names = ", ".join("abcd"[:n_arguments])
    space: dict[str, Callable[..., object]] = {"routine": routine}
    exec(f"def call({names}):\n    return routine({names})", space)
    return numba.njit(space["call"])


multiply = compiled(vectors.multiply, 3)
multiply_and_shift = compiled(vectors.multiply_and_shift, 4)
add_product = compiled(vectors.add_product, 3)
subtract_product = compiled(vectors.subtract_product, 3)
add_symmetric = compiled(vectors.add_symmetric, 3)
subtract_symmetric = compiled(vectors.subtract_symmetric, 3)
inner_products = compiled(vectors.inner_products, 3)
inner = compiled(vectors.inner, 2)
add_multiple = compiled(vectors.add_multiple, 3)
symmetric_products = compiled(vectors.symmetric_products, 3)


def framed(values: Array) -> tuple[Array, Array]:
    """Return a copy of a matrix inside a larger one, and the larger one, whose frame is NaN."""
    whole = np.full(np.add(values.shape, 2 * LANES), np.nan, values.dtype)
    inside = whole[LANES:-LANES, LANES:-LANES]
    inside[:] = values
    return inside, whole


def is_written_inside_alone(whole: Array) -> bool:
    """Return True if all of the frame is still NaN and nothing inside is."""
    inside = np.zeros(whole.shape, bool)
    inside[LANES:-LANES, LANES:-LANES] = True
    return bool((np.isnan(whole) != inside).all())


@given(SIZES, SIZES, SIZES, PRECISIONS, st.integers(0, 99))
def test_products_of_matrices_are_those_of_numpy_and_touch_nothing_else(
    n: int, k: int, m: int, precision: tuple[type, float], seed: int
) -> None:
    """Also where the first factor is a transposed matrix, or part of a larger one."""
    kind, error = precision
    rng = np.random.default_rng(seed)
    a, b, c, d = (rng.normal(size=s).astype(kind) for s in ((n, k), (k, m), (n, m), (m, k)))
    part, transposed, shift = framed(a)[0], np.asfortranarray(a), c[:, 0].copy()
    exact, size = a.astype(float) @ b, np.abs(a) @ np.abs(b) + np.abs(c) + 4.0
    for routine, operands, value in (
        (multiply, (transposed, framed(b)[0]), exact),
        (multiply_and_shift, (part, framed(b)[0], shift), exact + shift[:, None]),
        (add_product, (part, framed(b)[0]), c + exact),
        (subtract_product, (transposed, framed(b)[0]), c - exact),
    ):
        out, whole = framed(c)
        routine(*operands, out)
        assert (np.abs(out - value) <= error * size).all(), routine
        assert is_written_inside_alone(whole)
    out, whole = framed(c)
    inner_products(part, framed(d)[0], out)
    assert (np.abs(out - a.astype(float) @ d.T) <= error * (np.abs(a) @ np.abs(d).T)).all()
    assert is_written_inside_alone(whole)
    assert abs(inner(a[0].copy(), d[0].copy()) - out[0, 0]) <= error * np.abs(a[0]) @ np.abs(d[0])


def sums_in_order(left: Array, right: Array, start: Array, fused: bool) -> Array:
    """Return start + left right, term after term, with products that are rounded or not."""
    sums = np.empty((len(left), right.shape[1]))
    for (i, j), _ in np.ndenumerate(sums):
        total = float(start[i])
        for a, b in zip(left[i].tolist(), right[:, j].tolist(), strict=True):
            product = Fraction(a) * Fraction(b) if fused else Fraction(a * b)
            total = float(Fraction(total) + product)
        sums[i, j] = total
    return sums


@pytest.mark.parametrize("n", range(1, 10))
@pytest.mark.parametrize("k", [1, 5, 16])
def test_each_sum_of_a_product_is_taken_in_order(n: int, k: int) -> None:
    """Bit for bit: the losses of stored trials depend on it."""
    rng = np.random.default_rng(n)
    left, right, start = rng.normal(size=(n, k)), rng.normal(size=(k, 11)), rng.normal(size=n)
    out = np.empty((n, 11))
    multiply_and_shift(left, right, start, out)
    orders = [sums_in_order(left, right, start, fused) for fused in (True, False)]
    assert out.tolist() in [order.tolist() for order in orders]


@given(SIZES, PRECISIONS, st.integers(0, 99))
def test_a_multiple_changes_its_vector_alone(
    n: int, precision: tuple[type, float], seed: int
) -> None:
    kind, error = precision
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, n)).astype(kind)
    whole = np.concatenate([y, np.full(LANES, np.nan, kind)])
    add_multiple(whole[:n], kind(-1.5), x)
    assert (np.abs(whole[:n] - (y - 1.5 * x)) <= error * (np.abs(x) + np.abs(y))).all()
    assert np.isnan(whole[n:]).all()


@given(st.integers(1, 70), st.integers(1, 2 * GROUP + 1), st.integers(0, 99))
def test_symmetric_products_read_the_upper_blocks_alone(q: int, k: int, seed: int) -> None:
    """And a product has the same bits whichever others share the pass."""
    rng = np.random.default_rng(seed)
    Q = padded(q)
    A = aligned_zeros(Q, Q)
    A[:q, :q] = rng.normal(size=(q, q))
    A += A.T.copy()
    whole, x, y = A.copy(), aligned_zeros(k, Q), aligned_zeros(k, Q)
    x[:, :q] = rng.normal(size=(k, q))
    i, j = np.indices(A.shape)
    A[j < i // LANES * LANES] = np.nan
    symmetric_products(A, x, y)
    assert (np.abs(y - x @ whole) <= 1e-13 * (np.abs(x) @ np.abs(whole))).all()
    for n in range(k):
        alone = np.full((1, Q), np.nan)
        symmetric_products(A, x[n : n + 1], alone)
        assert np.array_equal(alone[0], y[n])


@given(st.integers(1, 40), st.integers(1, 20), st.integers(0, 99))
def test_a_symmetric_product_changes_the_upper_blocks_alone(q: int, n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    V, A = rng.normal(size=(n, q)), rng.normal(size=(q, q))
    A += A.T.copy()
    i, j = np.indices(A.shape)
    upper = j >= i // LANES * LANES
    for routine, sign in ((add_symmetric, 1.0), (subtract_symmetric, -1.0)):
        out = A.copy()
        routine(V.T, V, out)
        assert np.array_equal(out[~upper], A[~upper])
        assert out[upper] == pytest.approx((A + sign * V.T @ V)[upper], rel=1e-12, abs=1e-12)
        assert np.array_equal(out[upper & upper.T], out.T[upper & upper.T])


PROGRAM = """
import hashlib
import numpy as np
import tests.dopt.kernel.test_vectors as t
rng, digest = np.random.default_rng(0), hashlib.sha256()
for kind, error in ((np.float64, 1e-13), (np.float32, 1e-5)):
    for n, k, m in ((16, 4, 100), (2, 16, 33), (9, 7, 8), (1, 1, 1), (13, 3, 5), (386, 16, 386)):
        a, b = rng.normal(size=(n, k)).astype(kind), rng.normal(size=(k, m)).astype(kind)
        out, square = np.zeros((n, m), kind), np.zeros((n, n), kind)
        t.multiply_and_shift(a, b, a[:, 0].copy(), out)
        assert (np.abs(out - a[:, :1] - a @ b) <= error * (np.abs(a) @ np.abs(b) + 4.0)).all()
        t.subtract_product(a, b, out)
        assert (np.abs(out - a[:, :1]) <= error * (np.abs(a) @ np.abs(b) + 4.0)).all()
        t.inner_products(a, a, square)
        assert (np.abs(square - a @ a.T) <= error * (np.abs(a) @ np.abs(a).T)).all()
        t.add_multiple(out[0], kind(-1.5), b[0])
        digest.update(out.tobytes() + square.tobytes())
        digest.update(np.array(t.inner(out[0], out[-1])).tobytes())
A, x, y = t.aligned_zeros(392, 392), rng.normal(size=(7, 392)), np.zeros((7, 392))
A[:] = rng.normal(size=A.shape)
A += A.T.copy()
t.subtract_symmetric(x.T, x, A)
t.symmetric_products(A, x, y)
assert np.abs(y - x @ (np.triu(A) + np.triu(A, 1).T)).max() < 1e-9
digest.update(A.tobytes() + y.tobytes())
found = digest.hexdigest()
"""


def digest_on(processor: str) -> str:
    """Return a digest of products, which are checked, on another processor."""
    forced = {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": ""}
    return printed(f"{PROGRAM}print(found, end='')", **forced)


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="the other processors are x86-64 too")
def test_other_processors_give_the_same_bits() -> None:
    """With registers of 32 bytes; without fused multiply-add products are right up to rounding."""
    here: dict[str, str] = {}
    exec(PROGRAM, here)
    assert digest_on("x86-64-v3") == here["found"]
    digest_on("x86-64-v2")
