"""Equations as text: sums, products and elementary functions of named quantities, compiled.

Nothing but these is read, so that a text can do no harm.
"""

from __future__ import annotations

import ast
import contextlib
import keyword
import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dopt.errors import SpecificationError, unknown_name
from dopt.systems import elementary
from dopt.systems.properties import SPLIT
from dopt.types import Equation

FUNCTIONS = {
    name: getattr(elementary, name) for name in ("sin", "cos", "tanh", "magnitude", "sign", "where")
}
"""Functions that an expression may call (:mod:`dopt.systems.elementary`)."""

_ARGUMENTS = {"where": 3}  # 1 of the others

_WRITTEN = {"abs": "magnitude(x)", "fabs": "magnitude(x)", "sqrt": "x ** 0.5", "pow": "x ** y"}
"""Names to write in place of functions that people expect."""

_TRIED = 64
"""Values of each state and input, of all sizes and both signs, at which expressions are tried."""

_OPERATORS = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow)
_SIGNS = (ast.USub, ast.UAdd)
_COMPARISONS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)


def compiled_text(
    expressions: Mapping[str, str],
    arguments: Mapping[str, Sequence[str]],
    constants: Mapping[str, float] | None = None,
    units: Mapping[str, float] | None = None,
    results: Sequence[float] = (),
) -> Equation:
    """Return a function that gives the values of expressions, in their order.

    Parameters
    ----------
    expressions : mapping of str to str
        Name of each expression in messages, and its text, such as ``"-k * x + u / m"``.
    arguments : mapping of str to sequence of str
        Arguments of the function, each a sequence of named quantities.
    constants : mapping of str to float, optional
        Values of some of the quantities, with which each part has to be finite somewhere.
    units : mapping of str to float, optional
        What the arguments of some quantities are multiplied by.
    results : sequence of float, optional
        What the value of each expression is divided by, before it is rounded to 36 bits
        (:mod:`dopt.systems.properties`).

    Raises
    ------
    SpecificationError
        If a text is no such expression, uses a name that is not a quantity, or has a part
        such as ``u / m`` with m = 0.
    """
    names = [name for group in arguments.values() for name in group]
    values = _tried_values(names, constants or {})
    texts = [_checked(what, text, values) for what, text in expressions.items()]
    given = [f"_{argument}" for argument in arguments]  # no quantity begins with an underscore
    groups = zip(given, arguments.values(), strict=True)
    unpacked = [f"{', '.join(group)}, = {name}" for name, group in groups if group]
    shared = _Shared()
    texts = [ast.unparse(shared.visit(ast.parse(text, mode="eval").body)) for text in texts]
    steps = [f"{name} = {name} * {unit!r}" for name, unit in (units or {}).items()]
    steps += [f"{name} = {text}" for text, name in shared.names.items()]
    for i, unit in enumerate(results):
        steps += [f"_out{i} = ({texts[i]}) / {unit!r}", f"_split{i} = {SPLIT!r} * _out{i}"]
        texts[i] = f"_split{i} - (_split{i} - _out{i})"
    lines = [*unpacked, *steps, f"return ({', '.join(texts)},)"]
    source = "\n    ".join([f"def equation({', '.join(given)}):", *lines])
    namespace: dict[str, Any] = {**FUNCTIONS, "__name__": "expressions"}
    exec(source, namespace)  # of nothing but the expressions that were checked
    equation: Equation = namespace["equation"]
    return equation


class _Shared(ast.NodeTransformer):
    """Gives each operation a name, the same to equal ones, so that each is done once."""

    def __init__(self) -> None:
        self.names: dict[str, str] = {}

    def visit(self, node: ast.AST) -> Any:
        found = self.generic_visit(node)
        if not isinstance(found, ast.BinOp | ast.Call):
            return found
        name = self.names.setdefault(ast.unparse(found), f"_{len(self.names)}")
        return ast.Name(name)


def _check_finite(tree: ast.expr, what: str, values: Mapping[str, Any]) -> None:
    """Refuse an expression of which a part is a finite real number at none of the values."""
    parts = [node for node in ast.walk(tree) if isinstance(node, ast.BinOp | ast.Call)]
    for part in reversed(parts):  # the innermost first
        text, found = ast.unparse(part), np.zeros(1)
        with contextlib.suppress(ArithmeticError), np.errstate(all="ignore"):  # of numbers alone
            found = np.asarray(eval(text, {**FUNCTIONS, **values}))  # it was checked
        if np.iscomplexobj(found) or not np.isfinite(found).any():
            names = {node.id for node in ast.walk(part) if isinstance(node, ast.Name)}
            given = [f"{k} = {v:g}" for k, v in values.items() if k in names and np.ndim(v) == 0]
            raise SpecificationError(
                f"{what} is {ast.unparse(tree)!r}, of which {text} is finite nowhere"
                f"{' with ' * bool(given)}{', '.join(given)}, but numbers are expected of it: "
                f"correct the constants or the expression."
            )


def _tried_values(names: Sequence[str], constants: Mapping[str, float]) -> dict[str, Any]:
    """Return constants, and numbers of all sizes and both signs of the other quantities."""
    rng = np.random.default_rng(0)
    sizes = 10.0 ** rng.uniform(-3, 4, (len(names), _TRIED))
    tried = dict(zip(names, sizes * rng.choice([-1.0, 1.0], sizes.shape), strict=True))
    return {**tried, **{name: np.float64(value) for name, value in constants.items()}}


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


def _checked(what: str, text: str, values: Mapping[str, Any]) -> str:
    """Return the text of an expression in Python's own form, with real numbers alone.

    It is tried at the values of all quantities.
    """
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, AttributeError, TypeError, RecursionError) as error:
        raise _refused(what, text, "cannot be read") from error
    _check(tree, what, text, list(values))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant):
            node.value = float(node.value)  # type: ignore[arg-type]  # it was checked
    _check_finite(tree, what, values)
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
            if name in _WRITTEN:
                raise _refused(what, text, f"holds {name}", _WRITTEN[name])
            if name not in FUNCTIONS:
                raise unknown_name(f"function of {what}", name, FUNCTIONS)
            wanted = _ARGUMENTS.get(name, 1)
            if len(parts) != wanted:
                raise _refused(what, text, f"gives {name} {len(parts)} arguments, not {wanted}")
            if name == "where":
                parts = [*_compared(parts[0], what, text), *parts[1:]]
        case ast.BinOp(op=ast.BitXor()):
            raise _refused(what, text, f"holds {ast.unparse(node)}", "x ** y for a power")
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


def _refused(what: str, text: object, reason: str, instead: str = "") -> SpecificationError:
    remedy = f"write {instead}" if instead else "write it with these"
    return SpecificationError(
        f"{what} is {text!r}, which {reason}, but numbers, named quantities, sums, products, "
        f"powers and {', '.join(FUNCTIONS)} are expected: {remedy}."
    )
