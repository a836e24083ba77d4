"""Names of array and function types for annotations; numba never reads them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
"""Real numbers, with any number of axes."""

Vector = npt.NDArray[np.float64]
"""Real numbers along one axis."""

Matrix = npt.NDArray[np.float64]
"""Real numbers along two axes."""

Stack = npt.NDArray[np.float64]
"""Real numbers along three axes or more."""

Singles = npt.NDArray[np.float32]
"""Real numbers in single precision."""

Real = TypeVar("Real", Array, Singles)
"""Real numbers in either precision, the same for all arguments of a function."""

Complexes = npt.NDArray[np.complex128]
"""Complex numbers along one axis."""

Integers = npt.NDArray[np.int64]
"""Whole numbers along one axis."""

Buckets = npt.NDArray[np.uint32]
"""Places among the entries of a sketch along one axis."""

Signs = npt.NDArray[np.int8]
"""1 or -1, along one axis."""

Booleans = npt.NDArray[np.bool_]
"""Truth values along one axis."""

Scalar = Any  # one definition of an equation serves numbers, arrays, tensors and compiled code
"""Number, array or tensor."""

Equation = Callable[..., Sequence[Scalar]]
"""Equation of a system over the sequences of its states, inputs and parameters."""

NumbaType = Any  # numba's types and signatures have no annotations
"""Type or signature of numba."""

CompiledFunction = Any  # the class of numba's functions has no annotations
"""Function that numba has compiled."""

Known = Callable[[Vector, Vector, Vector, Vector], None]
"""Known part of dx/dt: state, input and physical parameters; writes into the last argument."""

Accelerations = Callable[[Vector, Vector, Vector], None]
"""Learned accelerations: state and physical parameters; writes into the last argument."""

ComplexAccelerations = Callable[[Complexes, Complexes, Complexes], None]
"""The same for complex arguments."""
