"""Fields of specifications: validated dataclass fields, and what the compiled kernel runs."""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
import sys
import types
import typing
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from dopt.errors import SpecificationError, unknown_name

_CLASS_VARIABLE = re.compile(r"(\w+\.)*ClassVar\b")


def check_own_fields(cls: type) -> None:
    """Refuse a class whose values a base class would hide.

    Raises
    ------
    SpecificationError
        If it, or a base class of it, declares fields but is no dataclass itself, or sets a field
        without a type.
    """
    for owner in cls.__mro__:
        if dataclasses.is_dataclass(owner):
            _check(owner)


def _check(cls: type) -> None:
    bases = [base for base in cls.__bases__ if dataclasses.is_dataclass(base)]
    inherited = {field.name for base in bases for field in dataclasses.fields(base)}
    annotations = inspect.get_annotations(cls)
    if "__dataclass_fields__" not in vars(cls):
        for key, annotation in annotations.items():
            if _CLASS_VARIABLE.match(str(annotation)) or key.startswith("_"):
                continue
            if key in inherited or not any(hasattr(base, key) for base in cls.__bases__):
                raise SpecificationError(
                    f"class {cls.__name__} declares {key}, but is no dataclass itself: put "
                    f"@dataclass(frozen=True, kw_only=True) above it."
                )
    for key in vars(cls):
        if key in inherited and key not in annotations:
            raise SpecificationError(
                f"class {cls.__name__} sets {key} without a type, which leaves the value of its "
                f"base class: declare it with its type, as {key}: float = parameter(...)."
            )


LARGEST_WHOLE = 2**31 - 1
"""Largest whole number of a specification, the largest of a database's integer column."""

Bound = Literal["any", "positive", "nonnegative", "fraction", "share"]

_LARGEST_REAL = sys.float_info.max

_BOUNDS: dict[str, tuple[Callable[[float], bool], str, str, int]] = {
    "any": (lambda _: True, "finite", "a finite number", -LARGEST_WHOLE),
    "positive": (lambda value: value > 0, "finite and above 0", "a positive number", 1),
    "nonnegative": (lambda value: value >= 0, "finite and at least 0", "0 or a positive number", 0),
    "fraction": (lambda x: 0 <= x < 1, "at least 0 and below 1", "a number from 0 to below 1", 0),
    "share": (lambda x: 0 < x <= 1, "above 0 and at most 1", "a positive number up to 1", 1),
}
"""Check of each bound, it in words, what to set a field to outside it, and the least integer."""


def parameter(
    default: Any,
    unit: str = "1",
    bound: Bound = "any",
    *,
    size: int | None = None,
    choices: tuple[str, ...] = (),
    added: bool = False,
) -> Any:
    """Declare a field with a unit and a bound.

    Parameters
    ----------
    default : number, tuple of numbers, str or None
        Default value. Its type is the type that the field accepts.
    unit : str
        Unit in the SI, ``"1"`` when dimensionless.
    bound : {"any", "positive", "nonnegative", "fraction", "share"}
        Bound on every number of the field.
    size : int, optional
        Number of entries that a tuple has to have.
    choices : tuple of str
        Valid texts, all if empty.
    added : bool
        Whether trials were stored before the field existed. Where it has its default it is then
        left out of what a trial's key is made of, so that the keys of stored trials stay; a
        stored configuration without the field has its default. It is no kernel number either.
    """
    about = {"unit": unit, "bound": bound, "size": size, "choices": choices, "added": added}
    return dataclasses.field(default=default, metadata=about)


def unvalidated(default: Any, *, added: bool = False) -> Any:
    """Declare a field that its class checks by itself; see :func:`parameter` for ``added``."""
    return dataclasses.field(default=default, metadata={"validated": False, "added": added})


@dataclasses.dataclass(frozen=True)
class Validated:
    """Base of the frozen specification dataclasses: types and bounds hold once one exists.

    Raises
    ------
    SpecificationError
        If a value has the wrong type, is not finite or lies outside its bound.
    """

    def __post_init__(self) -> None:
        kinds = _kinds(type(self))
        for field in dataclasses.fields(self):
            if field.name not in kinds:
                continue
            path, value = self._path(field.name), getattr(self, field.name)
            object.__setattr__(self, field.name, _converted(path, field, kinds[field.name], value))

    @classmethod
    def _path(cls, field: str) -> str:
        return f"{getattr(cls, 'section', 'trial')}.{field}"


class _Kind(NamedTuple):
    """Type of a field: one value or a tuple of values, perhaps None."""

    type: type[int] | type[float] | type[str]
    listed: bool = False
    optional: bool = False


def _kinds(cls: type[Validated]) -> dict[str, _Kind]:
    """Return what the fields of a class hold, read once from their annotations."""
    if cls not in _known:
        check_own_fields(cls)
        fields = [f for f in dataclasses.fields(cls) if f.metadata.get("validated", True)]
        _known[cls] = {field.name: _kind(cls, field) for field in fields}
    return _known[cls]


_known: dict[type, dict[str, _Kind]] = {}


def _kind(cls: type[Validated], field: dataclasses.Field[Any]) -> _Kind:
    """Return what a field holds.

    Raises
    ------
    SpecificationError
        If the annotation names another type than int, float, str, a tuple of one of them of any
        length, or one of these or None.
    """
    annotation = _annotation(cls, field)
    parts = _parts(annotation)
    kept = parts - {type(None)}
    listed = len(kept) == 1 and typing.get_origin(*kept) is tuple
    entries = (
        {entry for part in kept for entry in _parts(*typing.get_args(part))} if listed else kept
    )
    entries = {float} if entries == {int, float} else entries
    if len(entries) != 1 or not entries <= {int, float, str}:
        shown = annotation.__name__ if isinstance(annotation, type) else annotation
        raise SpecificationError(
            f"{cls._path(field.name)} of {cls.__name__} is annotated as {shown}, but "
            f"int, float, str, a tuple of one of them, or one of these with '| None' is "
            f"expected: change the annotation."
        )
    return _Kind(entries.pop(), listed, type(None) in parts)


def _parts(*annotations: Any) -> set[Any]:
    """Return the alternatives of annotations, without the dots of a tuple of any length."""
    found: set[Any] = set()
    for annotation in annotations:
        union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
        found |= set(typing.get_args(annotation)) if union else {annotation}
    return found - {...}


def _annotation(cls: type[Validated], field: dataclasses.Field[Any]) -> Any:
    """Return the type of a field, also where the module keeps its annotations as text."""
    if not isinstance(field.type, str):
        return field.type
    owner = next(base for base in cls.__mro__ if field.name in base.__dict__.get(_ANNOTATIONS, ()))
    holder = types.SimpleNamespace(**{_ANNOTATIONS: {field.name: field.type}})
    names = vars(sys.modules[owner.__module__])
    try:
        return typing.get_type_hints(holder, names, dict(vars(owner)))[field.name]
    except (NameError, AttributeError, TypeError, SyntaxError):
        return field.type


_ANNOTATIONS = "__annotations__"


def _converted(path: str, field: dataclasses.Field[Any], kind: _Kind, value: object) -> object:
    """Return ``value`` as what the annotation of ``field`` names."""
    if value is None and kind.optional:
        return None
    if not kind.listed:
        return _converted_entry(path, field, kind, value)
    size = field.metadata.get("size")
    what = "texts" if kind.type is str else "numbers"
    expected = f"a list of {size} {what}" if size else f"a list of {what}"
    if not isinstance(value, list | tuple) or (size and len(value) != size):
        raise _wrong_type(path, value, expected)
    return tuple(
        _converted_entry(f"{path}[{i}]", field, kind, entry) for i, entry in enumerate(value)
    )


def _converted_entry(
    path: str, field: dataclasses.Field[Any], kind: _Kind, value: object
) -> object:
    if kind.type is not str:
        return _converted_number(path, field, kind.type is int, value)
    if not isinstance(value, str):
        raise _wrong_type(path, value, "a text")
    choices = field.metadata.get("choices", ())
    if choices and value not in choices:
        raise unknown_name(path, value, choices)
    return value


def _converted_number(
    path: str, field: dataclasses.Field[Any], whole: bool, value: object
) -> float:
    expected = "a whole number" if whole else "a number"
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
        raise _wrong_type(path, value, expected)
    number = value if whole else _real(value)
    bound = field.metadata.get("bound", "any")
    holds, words, remedy, least = _BOUNDS[bound]
    if whole:
        words = f"from {least} to {LARGEST_WHOLE}"
        remedy = "a whole number in this range"
    if not abs(number) <= (LARGEST_WHOLE if whole else _LARGEST_REAL) or not holds(number):
        unit = field.metadata.get("unit", "1")
        suffix = "" if unit == "1" else f" {unit}"
        raise SpecificationError(
            f"{path} is {number}{suffix}, but it has to be {words}: set {path} to {remedy}."
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
    return SpecificationError(
        f"{path} is {given}, but {expected} is expected: set {path} to {expected}."
    )


IN_NUMPY = "dopt.kernel.loop.do_nothing"
"""Kernel function of parts that the interpreter runs."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class KernelSupport(Validated):
    """A specification that the kernel may run; the reference path runs what it does not.

    ``compiled`` says whether it does. A class with a ``name`` does not inherit it from another such
    class, whose algorithm may be another one: it declares it itself or is not compiled. It does
    inherit it from a class without a name, such as the base of open-loop policies, and from one
    whose algorithm is in numpy: the kernel has nothing of it.
    """

    compiled: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "name" in cls.__dict__ and "compiled" not in cls.__dict__:
            declaring = next(base for base in cls.__mro__ if "compiled" in base.__dict__)
            inherited = "name" not in declaring.__dict__ or cls.is_in_numpy()
            cls.compiled = declaring.__dict__["compiled"] and inherited

    @classmethod
    def is_in_numpy(cls) -> bool:
        """Return whether the interpreter runs the algorithm between compiled steps."""
        return False


def default_path(parts: Iterable[object]) -> str:
    """Return the path of a trial that names none, from its system, policy, model and learner.

    It is the kernel if each of them, an object or its class, is compiled.
    """
    return "kernel" if all(getattr(part, "compiled", False) for part in parts) else "reference"


@dataclasses.dataclass(frozen=True, kw_only=True)
class KernelPart(KernelSupport):
    """A policy or a learner: what the kernel runs of it is one compiled function.

    Attributes
    ----------
    kernel_function : str
        Dotted path of the function, which takes the trial (:class:`dopt.kernel.structs.Trial`), the
        step t, and the input to be written or the observed accelerations.
    brings_function : bool
        Whether the class itself has the function in place of a path.
    """

    kernel_function: ClassVar[str] = ""
    brings_function: ClassVar[bool] = False

    @classmethod
    def is_in_numpy(cls) -> bool:
        return cls.kernel_function == IN_NUMPY and not cls.brings_function

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:  # noqa: ARG002  # of most parts, the fields are enough
        """Return the numbers that the function takes, for q parameters and λ of M₀ = λI.

        They are the fields that hold one number, or one number or None, in the order of their
        declaration, base classes first; None is NaN. Added fields (:func:`dopt.fields.parameter`)
        are left out: the numbers of a class that is derived from theirs keep their places.
        """
        kinds, fields = _kinds(type(self)).items(), dataclasses.fields(self)
        single = {name for name, kind in kinds if kind.type is not str and not kind.listed}
        single -= {field.name for field in fields if field.metadata.get("added")}
        values = [getattr(self, field.name) for field in fields if field.name in single]
        return tuple(math.nan if value is None else float(value) for value in values)
