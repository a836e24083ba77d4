"""Equations written as text: sums, products and elementary functions of named quantities."""

from __future__ import annotations

import ast
import keyword
import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any

from dopt.errors import SpecificationError, unknown_name
from dopt.systems import elementary
from dopt.types import Equation

FUNCTIONS = {
    function.__name__: function
    for function in (
        elementary.sin,
        elementary.cos,
        elementary.tanh,
        elementary.magnitude,
        elementary.sign,
        elementary.where,
    )
}
"""Functions that an expression may call (:mod:`dopt.systems.elementary`)."""

_ARGUMENTS = {"where": 3}  # 1 of the others

_OPERATORS = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow)
_SIGNS = (ast.USub, ast.UAdd)
_COMPARISONS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)


def compiled_text(
    expressions: Mapping[str, str], arguments: Mapping[str, Sequence[str]]
) -> Equation:
    """Return a function whose values are those of expressions, in their order.

    Parameters
    ----------
    expressions : mapping of str to str
        Name of each expression in messages, and its text, such as ``"-k * x + u / m"``.
    arguments : mapping of str to sequence of str
        Arguments of the function, each a sequence of named quantities.

    Raises
    ------
    SpecificationError
        If a text is no such expression, or uses a name that is none of the quantities.
    """
    names = [name for group in arguments.values() for name in group]
    texts = [_checked(what, text, names) for what, text in expressions.items()]
    given = [f"_{argument}" for argument in arguments]  # no quantity begins with an underscore
    groups = zip(given, arguments.values(), strict=True)
    unpacked = [f"{', '.join(group)}, = {name}" for name, group in groups if group]
    lines = [*unpacked, f"return ({', '.join(texts)},)"]
    source = "\n    ".join([f"def equation({', '.join(given)}):", *lines])
    namespace: dict[str, Any] = {**FUNCTIONS, "__name__": "expressions"}
    exec(source, namespace)  # of nothing but the expressions that were checked
    equation: Equation = namespace["equation"]
    return equation


def check_names(what: str, names: Sequence[Any]) -> None:
    """Raise SpecificationError unless names can stand in expressions and differ."""
    for name in names:
        fits = isinstance(name, str) and name.isidentifier() and not keyword.iskeyword(name)
        if not fits or name.startswith("_") or unicodedata.normalize("NFKC", name) != name:
            raise SpecificationError(
                f"{what} has the name {name!r}, but letters, digits and underscores are expected, "
                f"a letter first: rename it."
            )
        if name in FUNCTIONS:
            raise SpecificationError(
                f"{what} has the name '{name}', which is a function of expressions: rename it."
            )
    double = sorted({name for name in names if list(names).count(name) > 1})
    if double:
        raise SpecificationError(
            f"{what} has the name '{double[0]}' more than once, but each quantity needs a name of "
            f"its own: rename one."
        )


def _checked(what: str, text: str, names: Sequence[str]) -> str:
    """Return the text of an expression in Python's own form, with real numbers alone."""
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, AttributeError, TypeError, RecursionError) as error:
        raise _refused(what, text, "cannot be read") from error
    _check(tree, what, text, names)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant):
            node.value = float(node.value)  # type: ignore[arg-type]  # it was checked
    return ast.unparse(tree)


def _check(node: ast.expr, what: str, text: str, names: Sequence[str]) -> None:
    """Refuse a node that is no number, quantity, sum, product, power or call of a function."""
    match node:
        case ast.Constant(value=int() | float() as value) if _fits(value):
            parts: list[ast.expr] = []
        case ast.Name(id=name):
            if name not in names:
                raise unknown_name(f"quantity of {what}", name, names)
            parts = []
        case ast.BinOp(left=left, op=operator, right=right) if isinstance(operator, _OPERATORS):
            parts = [left, right]
        case ast.UnaryOp(op=operator, operand=operand) if isinstance(operator, _SIGNS):
            parts = [operand]
        case ast.Call(func=ast.Name(id=name), args=parts, keywords=[]):
            if name not in FUNCTIONS:
                raise unknown_name(f"function of {what}", name, FUNCTIONS)
            wanted = _ARGUMENTS.get(name, 1)
            if len(parts) != wanted:
                raise _refused(what, text, f"gives {name} {len(parts)} arguments, not {wanted}")
            if name == "where":
                parts = [*_compared(parts[0], what, text), *parts[1:]]
        case _:
            raise _refused(what, text, f"holds {ast.unparse(node)}")
    for part in parts:
        _check(part, what, text, names)


def _fits(value: float) -> bool:
    return not isinstance(value, bool) and abs(value) < 1e300


def _compared(node: ast.expr, what: str, text: str) -> list[ast.expr]:
    """Return both sides of a comparison."""
    match node:
        case ast.Compare(left=left, ops=[operator], comparators=[right]):
            if isinstance(operator, _COMPARISONS):
                return [left, right]
    raise _refused(
        what, text, f"has the condition {ast.unparse(node)}, not one comparison by < or >"
    )


def _refused(what: str, text: object, reason: str) -> SpecificationError:
    return SpecificationError(
        f"{what} is {text!r}, which {reason}, but numbers, named quantities, sums, products, "
        f"powers and {', '.join(FUNCTIONS)} are expected: write it with these."
    )
