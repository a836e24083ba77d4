"""Products of matrices and vectors whose sums have a fixed order, for any processor.

The compiler's own vector code adds in an order that depends on the width of the registers. Here the
code is generated in terms of vectors of 64 bytes, eight doubles or sixteen floats, which LLVM
splits where registers are shorter, and every sum has one order:

- :func:`add_product` and its kin add the terms of an entry one by one, in the order of the inner
  index, each by a fused multiply-add;
- :func:`inner` and :func:`inner_products` add in the lanes of the vector, and then the upper half
  of the lanes to the lower one until one is left;
- :func:`symmetric_products` does both: the first for what is below the diagonal of a row.

Results are therefore the same bit for bit on all processors with fused multiply-add. The entries
that are computed at a time, a tile of the result, depend on how many registers there are; no sum
does. Rows of matrices have to be contiguous; only the left factor of :func:`add_product` may have
any strides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from dopt.kernel import plain
from dopt.kernel.compiler import compiled
from dopt.types import Matrix

LANES = 8
"""Doubles of a vector; arrays that are padded to a multiple of it have no incomplete one."""

GROUP = 3
"""Most vectors that :func:`symmetric_products` multiplies in one pass over the matrix."""

_INDEX = ir.IntType(64)


def padded(n: int) -> int:
    """Return the next multiple of :data:`LANES`."""
    return -(-n // LANES) * LANES


def aligned_zeros(*shape: int) -> Any:
    """Return zeros whose first entry begins a line of the cache, 64 bytes."""
    size = int(np.prod(shape))
    memory = np.zeros(size + LANES)
    start = -(memory.ctypes.data // 8) % LANES
    return memory[start : start + size].reshape(shape)


class _Code:
    """Writes the instructions of one routine for vectors of one type."""

    def __init__(self, builder: Any, element: Any) -> None:
        self.builder, self.element = builder, element
        self.lanes = LANES if element == ir.DoubleType() else 2 * LANES
        self.vector = ir.VectorType(element, self.lanes)

    def index(self, value: int) -> Any:
        return ir.Constant(_INDEX, value)

    def at(self, pointer: Any, *offsets: Any) -> Any:
        """Return the address of an entry: each offset is an index, or an index and a stride."""
        for offset in offsets:
            if isinstance(offset, tuple):
                offset = self.builder.mul(*offset)
            pointer = self.builder.gep(pointer, [offset])
        return pointer

    def load(self, address: Any, mask: Any = None) -> Any:
        address = self.builder.bitcast(address, self.vector.as_pointer())
        if mask is None:
            return self.builder.load(address, align=self._align)
        arguments = [address, self._alignment, mask, ir.Constant(self.vector, None)]
        return self._call(f"masked.load.{self._name}.p0", self.vector, arguments)

    def store(self, value: Any, address: Any, mask: Any = None) -> None:
        address = self.builder.bitcast(address, self.vector.as_pointer())
        if mask is None:
            self.builder.store(value, address, align=self._align)
            return
        arguments = [value, address, self._alignment, mask]
        self._call(f"masked.store.{self._name}.p0", ir.VoidType(), arguments)

    def splat(self, value: Any) -> Any:
        nothing = ir.Constant(ir.VectorType(value.type, self.lanes), ir.Undefined)
        one = self.builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
        places = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), [0] * self.lanes)
        return self.builder.shuffle_vector(one, nothing, places)

    def multiply_add(self, a: Any, b: Any, c: Any) -> Any:
        return self._call(f"fmuladd.{self._name}", self.vector, [a, b, c])

    def total(self, value: Any) -> Any:
        """Add the upper half of the lanes to the lower one until one is left."""
        n = self.lanes
        while n > 1:
            n //= 2
            nothing = ir.Constant(value.type, ir.Undefined)
            halves = [
                ir.Constant(ir.VectorType(ir.IntType(32), n), [*range(first, first + n)])
                for first in (0, n)
            ]
            lower, upper = (self.builder.shuffle_vector(value, nothing, half) for half in halves)
            value = self.builder.fadd(lower, upper)
        return self.builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    def first(self, count: Any) -> Any:
        """Return a mask of the first lanes."""
        counts = self.splat(count)
        places = ir.Constant(counts.type, [*range(self.lanes)])
        return self.builder.icmp_signed("<", places, counts)

    def variable(self, value: Any) -> Any:
        return cgutils.alloca_once_value(self.builder, value)

    def add_to(self, slot: Any, a: Any, b: Any) -> None:
        """Add a product to a variable."""
        self.builder.store(self.multiply_add(a, b, self.builder.load(slot)), slot)

    @contextmanager
    def loop(self, start: Any, stop: Any, step: int) -> Iterator[Any]:
        with cgutils.for_range_slice(self.builder, start, stop, self.index(step), intp=_INDEX) as (
            i,
            _,
        ):
            yield i

    def whole(self, start: Any, stop: Any, step: int) -> Any:
        """Return the end of the last whole step between two indices."""
        size = self.builder.sub(stop, start)
        return self.builder.sub(stop, self.builder.srem(size, self.index(step)))

    @property
    def _name(self) -> str:
        return f"v{self.lanes}f{8 * self._align}"

    @property
    def _align(self) -> int:
        return 8 if self.element == ir.DoubleType() else 4

    @property
    def _alignment(self) -> Any:
        return ir.Constant(ir.IntType(32), self._align)

    def _call(self, name: str, result: Any, arguments: Sequence[Any]) -> Any:
        kind = ir.FunctionType(result, [argument.type for argument in arguments])
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}")
        return self.builder.call(function, arguments)


def _routine(
    builder: Any, name: str, element: Any, arguments: Sequence[Any], write: Callable[..., None]
) -> Any:
    """Call a routine that all callers in a program share; ``write`` writes it when it is new."""
    kind = ir.FunctionType(ir.VoidType(), [argument.type for argument in arguments])
    name = f"dopt.{name}.{element}"
    function = builder.module.globals.get(name)
    if function is None:
        function = ir.Function(builder.module, kind, name)
        function.linkage = "linkonce_odr"
        function.attributes.add("noinline")
        inside = ir.IRBuilder(function.append_basic_block())
        write(_Code(inside, element), *function.args)
        inside.ret_void()
    return builder.call(function, arguments)


def _has_many_registers(context: Any) -> bool:
    """Return True if the processor has 32 registers of 64 bytes."""
    return "+avx512f" in context.codegen().magic_tuple()[2].split(",")


class _Array:
    """Address, shape and strides, in entries, of an array that compiled code is given."""

    def __init__(self, context: Any, builder: Any, kind: Any, value: Any) -> None:
        array = context.make_array(kind)(context, builder, value)
        self.data, self.element = array.data, array.data.type.pointee
        size = ir.Constant(_INDEX, 8 if self.element == ir.DoubleType() else 4)
        self.shape = cgutils.unpack_tuple(builder, array.shape)
        self.strides = [
            builder.sdiv(stride, size) for stride in cgutils.unpack_tuple(builder, array.strides)
        ]


def _arrays(context: Any, builder: Any, signature: Any, arguments: Any) -> list[_Array]:
    given = zip(signature.args, arguments, strict=True)
    return [_Array(context, builder, kind, value) for kind, value in given]


def _generator(start: str, sign: int, upper: bool) -> Callable[..., Any]:
    """Return what generates the code of a product of matrices.

    ``start`` says what sums begin with: "out", the result's own entry, "bias", an entry for each
    row, or "zero". ``upper``: only the blocks of :data:`LANES` rows and columns on and above the
    diagonal.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b, *rest = _arrays(context, builder, signature, arguments)
        out = rest[-1]
        bias = rest[0].data if start == "bias" else out.data
        height, vectors = (8, 2) if _has_many_registers(context) else (4, 1)

        def write(code: _Code, *given: Any) -> None:
            _write_product(code, start, sign, upper, height, vectors, *given)

        sizes = (out.shape[0], out.shape[1], a.shape[1])
        places = (a.data, *a.strides, b.data, b.strides[0], bias, out.data, out.strides[0])
        _routine(builder, f"product.{start}.{sign}.{upper}", out.element, (*sizes, *places), write)
        return context.get_dummy_value()

    return generate


def _in_numpy(left: Matrix, right: Matrix, out: Matrix) -> Matrix:
    """Return the part of a product that fits ``out``; factors may be larger."""
    n, m = out.shape
    part: Matrix = left[:n] @ right[: left.shape[1], :m]
    return part


def _product(start: str, sign: int, *, upper: bool = False) -> Any:
    """Return a product of matrices (n, k) and (k, m) for compiled code; see :func:`_generator`."""

    def in_numpy(left: Matrix, right: Matrix, out: Matrix) -> None:
        out[:] = sign * _in_numpy(left, right, out) + (out if start == "out" else 0.0)

    def typed(typing_context, left, right, out):  # type: ignore[no-untyped-def]  # noqa: ARG001  # Numba's signature
        return types.void(left, right, out), _generator(start, sign, upper)

    return plain.or_plain(in_numpy)(intrinsic(typed))


def _write_product(
    code: _Code,
    start: str,
    sign: int,
    upper: bool,
    height: int,
    vectors: int,
    n_rows: Any,
    n_columns: Any,
    n_terms: Any,
    left: Any,
    left_row: Any,
    left_column: Any,
    right: Any,
    right_row: Any,
    bias: Any,
    out: Any,
    out_row: Any,
) -> None:
    builder, zero = code.builder, code.index(0)

    def tile(i: Any, j: Any, rows: int, across: int, mask: Any) -> None:
        columns = [builder.add(j, code.index(v * code.lanes)) for v in range(across)]
        targets, factors, sums = [], [], []
        for r in range(rows):
            row = builder.add(i, code.index(r))
            targets.append([code.at(out, (row, out_row), column) for column in columns])
            factors.append(code.at(left, (row, left_row)))
            if start == "out":
                values = [code.load(target, mask) for target in targets[r]]
            elif start == "bias":
                values = [code.splat(builder.load(code.at(bias, row)))] * across
            else:
                values = [ir.Constant(code.vector, None)] * across
            sums.append([code.variable(value) for value in values])
        with code.loop(zero, n_terms, 1) as k:
            terms = [code.load(code.at(right, (k, right_row), column), mask) for column in columns]
            for r in range(rows):
                factor = builder.load(code.at(factors[r], (k, left_column)))
                factor = code.splat(factor if sign > 0 else builder.fneg(factor))
                for v in range(across):
                    code.add_to(sums[r][v], factor, terms[v])
        for r in range(rows):
            for v in range(across):
                code.store(builder.load(sums[r][v]), targets[r][v], mask)

    def rows(i: Any, count: int) -> None:
        first = builder.and_(i, code.index(-LANES)) if upper else zero
        across = vectors if count > 1 else 2 * vectors
        middle = code.whole(first, n_columns, across * code.lanes)
        with code.loop(first, middle, across * code.lanes) as j:
            tile(i, j, count, across, None)
        with code.loop(middle, n_columns, code.lanes) as j:
            tile(i, j, count, 1, code.first(builder.sub(n_columns, j)))

    last = code.whole(zero, n_rows, height)
    with code.loop(zero, last, height) as i:
        rows(i, height)
    with code.loop(last, n_rows, 1) as i:
        rows(i, 1)


multiply = _product("zero", 1)
"""Write the product of matrices (n, k) and (k, m)."""

add_product = _product("out", 1)
"""Add the product of matrices (n, k) and (k, m)."""

subtract_product = _product("out", -1)
"""Subtract the product of matrices (n, k) and (k, m)."""

subtract_symmetric = _product("out", -1, upper=True)
"""Subtract a symmetric product from the blocks on and above the diagonal of a matrix, (q, q).

Blocks have :data:`LANES` rows and columns; those on the diagonal are whole.
"""

add_symmetric = _product("out", 1, upper=True)
"""Add a symmetric product as :func:`subtract_symmetric` subtracts one."""


@plain.or_plain(lambda a, b, bias, out: np.add(_in_numpy(a, b, out), bias[:, None], out=out))
@intrinsic
def multiply_and_shift(typing_context, left, right, bias, out):  # type: ignore[no-untyped-def]  # noqa: ARG001
    """Write the product of matrices (n, k) and (k, m) plus a column, (n,)."""
    return types.void(left, right, bias, out), _generator("bias", 1, upper=False)


@plain.or_plain(lambda a, b, out: np.copyto(out, _in_numpy(a, b.T, out)))
@intrinsic
def inner_products(typing_context, left, right, out):  # type: ignore[no-untyped-def]  # noqa: ARG001
    """Write the inner products of the rows of two matrices, (n, k) and (m, k), (n, m)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b, c = _arrays(context, builder, signature, arguments)
        side = 4 if _has_many_registers(context) else 2

        def write(code: _Code, *given: Any) -> None:
            _write_inner_products(code, side, *given)

        sizes = (*c.shape, a.shape[1])
        places = (a.data, a.strides[0], b.data, b.strides[0], c.data, *c.strides)
        _routine(builder, "inner_products", c.element, (*sizes, *places), write)
        return context.get_dummy_value()

    return types.void(left, right, out), generate


def _write_inner_products(
    code: _Code,
    side: int,
    n_rows: Any,
    n_columns: Any,
    n_terms: Any,
    left: Any,
    left_row: Any,
    right: Any,
    right_row: Any,
    out: Any,
    out_row: Any,
    out_column: Any,
) -> None:
    builder, zero = code.builder, code.index(0)
    middle = code.whole(zero, n_terms, code.lanes)

    def tile(i: Any, j: Any, rows: int, columns: int) -> None:
        def addresses(data: Any, stride: Any, first: Any, count: int) -> list[Any]:
            places = [builder.add(first, code.index(n)) for n in range(count)]
            return [code.at(data, (place, stride)) for place in places]

        above, below = addresses(left, left_row, i, rows), addresses(right, right_row, j, columns)
        nothing = ir.Constant(code.vector, None)
        sums = [[code.variable(nothing) for _ in range(columns)] for _ in range(rows)]

        def add(n: Any, mask: Any) -> None:
            factors = [code.load(code.at(address, n), mask) for address in below]
            for r in range(rows):
                value = code.load(code.at(above[r], n), mask)
                for c in range(columns):
                    code.add_to(sums[r][c], value, factors[c])

        with code.loop(zero, middle, code.lanes) as n:
            add(n, None)
        with builder.if_then(builder.icmp_signed("<", middle, n_terms)):
            add(middle, code.first(builder.sub(n_terms, middle)))
        targets = addresses(out, out_row, i, rows)
        for r in range(rows):
            for c in range(columns):
                place = (builder.add(j, code.index(c)), out_column)
                builder.store(code.total(builder.load(sums[r][c])), code.at(targets[r], place))

    def across(i: Any, rows: int) -> None:
        last = code.whole(zero, n_columns, side)
        with code.loop(zero, last, side) as j:
            tile(i, j, rows, side)
        with code.loop(last, n_columns, 1) as j:
            tile(i, j, rows, 1)

    last = code.whole(zero, n_rows, side)
    with code.loop(zero, last, side) as i:
        across(i, side)
    with code.loop(last, n_rows, 1) as i:
        across(i, 1)


@plain.or_plain(np.dot)
@intrinsic
def inner(typing_context, a, b):  # type: ignore[no-untyped-def]  # noqa: ARG001
    """Return aᵀb of two contiguous vectors, (n,); four vectors of lanes are added at a time."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        first, second = _arrays(context, builder, signature, arguments)
        result = cgutils.alloca_once(builder, first.element)
        given = (first.shape[0], first.data, second.data, result)
        _routine(builder, "inner", first.element, given, _write_inner)
        return builder.load(result)

    return a.dtype(a, b), generate


def _write_inner(code: _Code, n: Any, a: Any, b: Any, result: Any) -> None:
    builder, zero = code.builder, code.index(0)
    sums = [code.variable(ir.Constant(code.vector, None)) for _ in range(4)]
    step = len(sums) * code.lanes
    middle = code.whole(zero, n, step)
    with code.loop(zero, middle, step) as i:
        for s, total in enumerate(sums):
            place = builder.add(i, code.index(s * code.lanes))
            code.add_to(total, code.load(code.at(a, place)), code.load(code.at(b, place)))
    with code.loop(middle, n, code.lanes) as i:
        mask = code.first(builder.sub(n, i))
        code.add_to(sums[0], code.load(code.at(a, i), mask), code.load(code.at(b, i), mask))
    w, x, y, z = map(builder.load, sums)
    builder.store(code.total(builder.fadd(builder.fadd(w, x), builder.fadd(y, z))), result)


@plain.or_plain(lambda upper, x, y: np.matmul(x, np.triu(upper) + np.triu(upper, 1).T, out=y))
@intrinsic
def _group_products(typing_context, upper, x, y):  # type: ignore[no-untyped-def]  # noqa: ARG001
    """Write the products of at most :data:`GROUP` rows with a symmetric matrix."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b, c = _arrays(context, builder, signature, arguments)
        heights = (4, 4, 4) if _has_many_registers(context) else (4, 2, 1)
        given = (c.shape[1], a.data, a.strides[0], b.data, b.strides[0], c.data, c.strides[0])
        for count, height in enumerate(heights, start=1):
            chosen = builder.icmp_signed("==", c.shape[0], ir.Constant(_INDEX, count))
            with builder.if_then(chosen):

                def write(code: _Code, *given: Any, n: int = count, rows: int = height) -> None:
                    _write_symmetric(code, n, rows, *given)

                _routine(builder, f"symmetric.{count}", c.element, given, write)
        return context.get_dummy_value()

    return types.void(upper, x, y), generate


def _write_symmetric(
    code: _Code,
    count: int,
    height: int,
    q: Any,
    upper: Any,
    upper_row: Any,
    x: Any,
    x_row: Any,
    y: Any,
    y_row: Any,
) -> None:
    """Take ``height`` rows of the matrix at a time: each vector is then loaded once for all."""
    builder, zero = code.builder, code.index(0)
    xs = [code.at(x, (code.index(k), x_row)) for k in range(count)]
    ys = [code.at(y, (code.index(k), y_row)) for k in range(count)]
    with code.loop(zero, q, code.lanes) as j:
        for one in ys:
            code.store(ir.Constant(code.vector, None), code.at(one, j))
    with code.loop(zero, q, height) as i:
        places = [builder.add(i, code.index(r)) for r in range(height)]
        rows = [code.at(upper, (place, upper_row)) for place in places]
        diagonal = builder.and_(i, code.index(-code.lanes))
        values = [code.load(code.at(one, diagonal)) for one in xs]
        sums = []
        for row in rows:
            entries = code.load(code.at(row, diagonal))
            sums.append([code.variable(builder.fmul(entries, value)) for value in values])
        factors = [
            [code.splat(builder.load(code.at(one, place))) for one in xs] for place in places
        ]
        with code.loop(builder.add(diagonal, code.index(code.lanes)), q, code.lanes) as j:
            values = [code.load(code.at(one, j)) for one in xs]
            totals = [code.load(code.at(one, j)) for one in ys]
            for r, row in enumerate(rows):
                entries = code.load(code.at(row, j))
                for k in range(count):
                    code.add_to(sums[r][k], entries, values[k])
                    totals[k] = code.multiply_add(entries, factors[r][k], totals[k])
            for one, total in zip(ys, totals, strict=True):
                code.store(total, code.at(one, j))
        for r, place in enumerate(places):
            for k in range(count):
                address = code.at(ys[k], place)
                added = code.total(builder.load(sums[r][k]))
                builder.store(builder.fadd(builder.load(address), added), address)


@compiled
def symmetric_products(upper: Matrix, x: Matrix, y: Matrix) -> None:
    """Write y = x A, (k, q), for a symmetric matrix A, (q, q), q a multiple of :data:`LANES`.

    Read are the blocks of :data:`LANES` rows and columns on and above the diagonal.
    """
    k = x.shape[0]
    for i in range(0, k, GROUP):
        last = min(i + GROUP, k)
        _group_products(upper, x[i:last], y[i:last])


@plain.or_plain(lambda y, factor, x: np.add(y, factor * x, out=y))
@intrinsic
def add_multiple(typing_context, y, factor, x):  # type: ignore[no-untyped-def]  # noqa: ARG001
    """Add factor x to y, (n,)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        to, by = (_Array(context, builder, signature.args[n], arguments[n]) for n in (0, 2))
        given = (to.shape[0], to.data, arguments[1], by.data)
        _routine(builder, "add_multiple", to.element, given, _write_add_multiple)
        return context.get_dummy_value()

    return types.void(y, y.dtype, x), generate


def _write_add_multiple(code: _Code, n: Any, y: Any, factor: Any, x: Any) -> None:
    builder, factors = code.builder, code.splat(factor)

    def add(i: Any, mask: Any) -> None:
        value = code.load(code.at(y, i), mask)
        value = code.multiply_add(factors, code.load(code.at(x, i), mask), value)
        code.store(value, code.at(y, i), mask)

    zero = code.index(0)
    middle = code.whole(zero, n, code.lanes)
    with code.loop(zero, middle, code.lanes) as i:
        add(i, None)
    with builder.if_then(builder.icmp_signed("<", middle, n)):
        add(middle, code.first(builder.sub(n, middle)))


@plain.or_plain(lambda a, b, c: a * b + c)
@intrinsic
def multiply_add(typing_context, a, b, c):  # type: ignore[no-untyped-def]  # noqa: ARG001
    """Return a b + c, rounded once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001
        kind = arguments[0].type
        name = f"llvm.fmuladd.f{64 if kind == ir.DoubleType() else 32}"
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind] * 3), name
        )
        return builder.call(function, arguments)

    return c(c, c, c), generate


@compiled
def product(left: Matrix, right: Matrix) -> Matrix:
    """Return the product of matrices (n, k) and (k, m)."""
    out = np.empty((left.shape[0], right.shape[1]))
    multiply(left, right, out)
    return out
