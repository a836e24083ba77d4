"""Checks of arguments: kinds, whole and real numbers, and rows of them."""

from __future__ import annotations

import math
from types import UnionType
from typing import Any

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError
from dopt.fields import LARGEST_WHOLE
from dopt.types import Array


def instance(what: str, given: object, kinds: type | UnionType, expected: str) -> None:
    """Raise SpecificationError unless something is of one of some kinds."""
    if not isinstance(given, kinds):
        shown = f"the class {given.__name__}" if isinstance(given, type) else repr(given)
        raise SpecificationError(f"{what} is {shown}, but {expected} is expected: give one.")


def whole(what: str, given: object, lower: int = -LARGEST_WHOLE, upper: int = LARGEST_WHOLE) -> int:
    """Return a whole number within bounds, or raise SpecificationError."""
    if not _is_real(given, "iu") or not lower <= int(given) <= upper:  # type: ignore[call-overload]
        least = f" of at least {lower}" if lower > -LARGEST_WHOLE else ""
        bounds = f" from {lower} to {upper:,}" if upper != LARGEST_WHOLE else least
        shown = "null" if given is None else repr(given)
        raise SpecificationError(
            f"{what} is {shown}, but a whole number{bounds} is expected: correct it."
        )
    return int(given)  # type: ignore[call-overload,no-any-return]


def reals(what: str, given: npt.ArrayLike) -> Array:
    """Return an array of real numbers, or raise SpecificationError."""
    values = as_array(given)
    if values.dtype.kind not in "fiu":
        raise SpecificationError(
            f"{what} of the type {values.dtype} were given, but an array of real numbers is "
            f"expected: correct them."
        )
    return values.astype(np.float64)


def numbers(what: str, given: npt.ArrayLike, size: int) -> Array:
    """Return so many real numbers, or raise SpecificationError."""
    values = as_array(given)
    if values.shape != (size,) or values.dtype.kind not in "fiu":
        raise SpecificationError(
            f"{what} has the shape {values.shape} and the type {values.dtype}, but {size} real "
            f"{'number is' if size == 1 else 'numbers are'} expected: correct it."
        )
    return values.astype(np.float64)


def finite(what: str, given: npt.ArrayLike, size: int) -> Array:
    """Return so many finite numbers, or raise SpecificationError."""
    values = numbers(what, given, size)
    if not np.isfinite(values).all():
        raise SpecificationError(
            f"{what} is {values.tolist()}, but finite numbers are expected: correct it."
        )
    return values


def rows_of(what: str, given: npt.ArrayLike, size: int) -> Array:
    """Return rows of so many real numbers, (N, size), or raise SpecificationError."""
    values = np.atleast_2d(reals(what, given))
    if values.ndim != 2 or values.shape[1] != size:
        raise SpecificationError(
            f"{what} of shape {np.shape(given)} were given, but (N, {size}) is expected: correct "
            f"them."
        )
    return values


def check_finite(what: str, values: Array) -> None:
    """Raise SpecificationError unless all numbers of some rows are finite."""
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(wrong):
        raise SpecificationError(
            f"row {wrong[0]} of the {what} is {values[wrong[0]].tolist()}, but finite numbers are "
            f"expected: give a part without such rows."
        )


def within(what: str, given: float, upper: float) -> float:
    """Return a real number above 0 and below a bound."""
    if not _is_real(given) or not 0.0 < given < upper:
        raise SpecificationError(
            f"{what} is {given!r}, but a number above 0"
            f"{f' and below {upper:g}' if upper < math.inf else ''} is expected: correct it."
        )
    return float(given)


def seconds(given: float | None) -> float | None:
    """Return a time in seconds, or raise SpecificationError."""
    if given is not None and not (_is_real(given) and math.isfinite(given)):
        raise SpecificationError(
            f"time is {given!r}, but a finite number of seconds is expected: correct it, or leave "
            f"it out."
        )
    return None if given is None else float(given)


def _is_real(given: object, kinds: str = "fiu") -> bool:
    value = as_array(given)
    return value.shape == () and value.dtype.kind in kinds


def as_array(given: Any) -> npt.NDArray[Any]:
    """Return an array of anything; of objects where numbers do not make one."""
    try:
        return np.asarray(given)
    except ValueError:  # rows of different lengths
        return np.asarray(given, dtype=object)
    except (TypeError, RuntimeError):
        return np.array(None)
