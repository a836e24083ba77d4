"""Check that the fields which a class declares are fields of its dataclass."""

from __future__ import annotations

import dataclasses
import inspect
import re

from dopt.errors import SpecificationError

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
