"""Derivatives of equations that are given as text, as a function that can be compiled.

Each expression is taken apart into operations, equal ones once, and each is differentiated by the
chain rule. At a corner (:mod:`dopt.systems.elementary`) the derivative is the one along increasing
arguments. The derivative of a power is 0 at the base 0, and by its exponent at bases below 0, too.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dopt.systems.expressions import FUNCTIONS
from dopt.types import Booleans, Equation

_SYMBOLS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}

Slopes = dict[str, str]
"""Derivatives that are not always 0, by the quantity."""


def differentiated_text(
    texts: Sequence[str], arguments: Mapping[str, Sequence[str]], by: Sequence[str]
) -> tuple[Equation, Booleans]:
    """Return a function that writes values and derivatives, and which of these may differ from 0.

    Parameters
    ----------
    texts : sequence of str
        n expressions, which :func:`dopt.systems.expressions.compiled_text` has accepted.
    arguments : mapping of str to sequence of str
        Arguments of the function, each an array of named quantities. Two more are written: (n,)
        values and (n, k) derivatives, except where they are always 0.
    by : sequence of str
        k quantities; for none of them there are no derivatives to write.

    Returns
    -------
    function, where : function and (n, k)
    """
    chain = _Chain(by)
    rows = [chain.of(ast.parse(text.strip(), mode="eval").body) for text in texts]
    given = [f"_{argument}" for argument in arguments]  # no quantity begins with an underscore
    lines = [
        f"{name} = {group}[{i}]"
        for group, names in zip(given, arguments.values(), strict=True)
        for i, name in enumerate(names)
    ]
    lines += [f"{name} = {text}" for text, name in chain.names.items()]
    for i, (value, slopes) in enumerate(rows):
        lines.append(f"_values[{i}] = {value}")
        lines += [f"_slopes[{i}, {by.index(name)}] = {slope}" for name, slope in slopes.items()]
    given += ["_values", "_slopes"] if by else ["_values"]
    source = "\n    ".join([f"def equation({', '.join(given)}):", *lines])
    namespace: dict[str, Any] = {**FUNCTIONS, "log": math.log, "__name__": "derivatives"}
    exec(source, namespace)  # of nothing but expressions that were checked
    return namespace["equation"], np.array([[name in slopes for name in by] for _, slopes in rows])


class _Chain:
    """Operations, each with a name, and their derivatives."""

    def __init__(self, by: Sequence[str]) -> None:
        self.by = by
        self.names: dict[str, str] = {}

    def of(self, node: ast.expr) -> tuple[str, Slopes]:
        """Return the name of a value, and its derivatives."""
        match node:
            case ast.Constant(value=value):
                return self._named(repr(float(value))), {}  # type: ignore[arg-type]  # checked
            case ast.Name(id=name):
                return name, {name: "1.0"} if name in self.by else {}
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                x, dx = self.of(operand)
                return self._named(f"-{x}"), self._sum(("-1.0", dx))
            case ast.UnaryOp(operand=operand):
                return self.of(operand)
            case ast.BinOp(left=left, op=operator, right=right):
                return self._operation(type(operator), self.of(left), self.of(right), right)
            case ast.Call(func=ast.Name(id="where"), args=[condition, *either]):
                return self._either(condition, *map(self.of, either))
            case ast.Call(func=ast.Name(id=function), args=[argument]):
                return self._function(function, *self.of(argument))
        raise TypeError(ast.unparse(node))

    def _operation(
        self,
        kind: type[ast.operator],
        left: tuple[str, Slopes],
        right: tuple[str, Slopes],
        power: ast.expr,
    ) -> tuple[str, Slopes]:
        (a, da), (b, db) = left, right
        out = self._named(f"{a} {_SYMBOLS[kind]} {b}")
        if kind is ast.Add:
            return out, self._sum(("1.0", da), ("1.0", db))
        if kind is ast.Sub:
            return out, self._sum(("1.0", da), ("-1.0", db))
        if kind is ast.Mult:
            return out, self._sum((b, da), (a, db))
        if kind is ast.Div:
            return out, self._sum((f"1.0 / {b}", da), (f"-{out} / {b}", db))
        match power:
            case ast.Constant(value=0 | 1 | 2 as k):
                return out, self._sum((f"{k}.0 * {a}" if k == 2 else "1.0", da if k else {}))
        base = self._named(f"where({a} > 0.0, {a}, 1.0)")
        other = self._named(f"where({a} == 0.0, 1.0, {a})")
        return out, self._sum((f"{b} * {out} / {other}", da), (f"{out} * log({base})", db))

    def _function(self, name: str, x: str, dx: Slopes) -> tuple[str, Slopes]:
        out = self._named(f"{name}({x})")
        slope = {
            "sin": f"cos({x})",
            "cos": f"-sin({x})",
            "tanh": f"1.0 - {out} * {out}",
            "magnitude": f"where({x} >= 0.0, 1.0, -1.0)",
            "sign": "",
        }[name]
        return out, self._sum((slope, dx if slope else {}))

    def _either(
        self, condition: ast.expr, first: tuple[str, Slopes], second: tuple[str, Slopes]
    ) -> tuple[str, Slopes]:
        assert isinstance(condition, ast.Compare)
        (x, _), (y, _) = self.of(condition.left), self.of(condition.comparators[0])
        sign = ast.unparse(ast.Compare(ast.Name(x), condition.ops, [ast.Name(y)]))
        (a, da), (b, db) = first, second
        return self._named(f"where({sign}, {a}, {b})"), {
            name: self._named(f"where({sign}, {da.get(name, '0.0')}, {db.get(name, '0.0')})")
            for name in {**da, **db}
        }

    def _sum(self, *terms: tuple[str, Slopes]) -> Slopes:
        """Return the sums of derivatives times factors."""
        sums: Slopes = {}
        for factor, slopes in terms:
            for name, slope in slopes.items():
                if factor == "1.0":
                    term = slope
                else:
                    term = self._named(factor)
                    term = term if slope == "1.0" else self._named(f"{term} * {slope}")
                sums[name] = self._named(f"{sums[name]} + {term}") if name in sums else term
        return sums

    def _named(self, text: str) -> str:
        return text if text.isidentifier() else self.names.setdefault(text, f"_{len(self.names)}")
