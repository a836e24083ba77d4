"""Dataclass fields that know their unit and bounds, and check what they are given."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable
from typing import Any, Literal

from dopt.errors import SpecificationError, unknown_name

LARGEST_WHOLE = 2**31 - 1
"""Whole numbers of a specification fit into the columns of every database."""

Bound = Literal["any", "positive", "nonnegative", "fraction", "share"]

_LARGEST_REAL = sys.float_info.max

_BOUNDS: dict[str, tuple[Callable[[float], bool], str]] = {
    "any": (lambda _: True, "finite"),
    "positive": (lambda value: value > 0, "finite and above 0"),
    "nonnegative": (lambda value: value >= 0, "finite and at least 0"),
    "fraction": (lambda value: 0 <= value < 1, "at least 0 and below 1"),
    "share": (lambda value: 0 < value <= 1, "above 0 and at most 1"),
}

_SMALLEST_WHOLE = {
    "any": -LARGEST_WHOLE,
    "positive": 1,
    "nonnegative": 0,
    "fraction": 0,
    "share": 1,
}


def quantity(
    default: Any,
    unit: str = "1",
    bound: Bound = "any",
    *,
    size: int | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare a field with a unit and a bound.

    Parameters
    ----------
    default : number, tuple of numbers, str or None
        Default value. Its type is the type that the field accepts.
    unit : str
        Unit in the SI, ``"1"`` when dimensionless.
    bound : {"any", "positive", "nonnegative", "fraction", "share"}
        What every number of the field has to satisfy.
    size : int, optional
        Number of entries that a tuple has to have.
    choices : tuple of str
        Valid texts, all if empty.
    """
    return dataclasses.field(
        default=default, metadata={"unit": unit, "bound": bound, "size": size, "choices": choices}
    )


@dataclasses.dataclass(frozen=True)
class Checked:
    """Base of the frozen specification dataclasses: types and bounds hold once one exists.

    Raises
    ------
    SpecificationError
        If a value has the wrong type, is not finite or lies outside its bound.
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = _converted(self._path(field.name), field, getattr(self, field.name))
            object.__setattr__(self, field.name, value)

    @classmethod
    def _path(cls, field: str) -> str:
        return f"{getattr(cls, 'section', 'trial')}.{field}"


def _converted(path: str, field: dataclasses.Field[Any], value: object) -> object:
    """Return ``value`` as the type that the annotation of ``field`` names."""
    kind = str(field.type)
    if value is None and "None" in kind:
        return None
    if kind.startswith("tuple"):
        return _converted_tuple(path, field, kind, value)
    if kind.startswith("str"):
        if not isinstance(value, str):
            raise _wrong_type(path, value, "a text")
        choices = field.metadata.get("choices", ())
        if choices and value not in choices:
            raise unknown_name(path, value, choices)
        return value
    return _converted_number(path, field, kind.startswith("int"), value)


def _converted_tuple(
    path: str, field: dataclasses.Field[Any], kind: str, value: object
) -> tuple[float, ...]:
    size = field.metadata.get("size")
    expected = f"a list of {size} numbers" if size else "a list of numbers"
    if not isinstance(value, list | tuple) or (size and len(value) != size):
        raise _wrong_type(path, value, expected)
    whole = "int" in kind
    return tuple(
        _converted_number(f"{path}[{i}]", field, whole, entry) for i, entry in enumerate(value)
    )


def _converted_number(
    path: str, field: dataclasses.Field[Any], whole: bool, value: object
) -> float:
    expected = "a whole number" if whole else "a number"
    if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
        raise _wrong_type(path, value, expected)
    number = value if whole else _real(value)
    bound = field.metadata.get("bound", "any")
    holds, words = _BOUNDS[bound]
    if whole:
        words = f"from {_SMALLEST_WHOLE[bound]} to {LARGEST_WHOLE}"
    if not abs(number) <= (LARGEST_WHOLE if whole else _LARGEST_REAL) or not holds(number):
        unit = field.metadata.get("unit", "1")
        suffix = "" if unit == "1" else f" {unit}"
        raise SpecificationError(
            f"{path} is {number}{suffix}, but it has to be {words}: set it so."
        )
    return number


def _real(value: float) -> float:
    """Return a float, never -0.0: equal values have one key; infinite when it is too large."""
    try:
        return float(value) + 0.0
    except OverflowError:
        return math.inf


def _wrong_type(path: str, value: object, expected: str) -> SpecificationError:
    given = "null" if value is None else f"{value!r} ({type(value).__name__})"
    return SpecificationError(f"{path} is {given}, but {expected} is expected: set it so.")
