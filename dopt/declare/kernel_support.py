"""Declarations by which a part of a trial says whether and how the compiled kernel runs it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import ClassVar

from dopt.declare.validated_fields import Validated

PLAN_IN_NUMPY = "dopt.kernel.absent_steps.plan"
LEARN_IN_NUMPY = "dopt.kernel.absent_steps.learn"
IN_NUMPY = (PLAN_IN_NUMPY, LEARN_IN_NUMPY)
"""Kernel functions of parts that the interpreter runs: they do nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class KernelSupport(Validated):
    """A specification that the kernel may run; the reference path runs what it does not.

    ``compiled`` says whether it does. A class with a ``name`` does not inherit it from another such
    class, whose algorithm may be another one: it declares it itself or is not compiled. It does
    inherit it from a class without a name, such as that of all open-loop policies, and from one
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
        return cls.kernel_function in IN_NUMPY and not cls.brings_function

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:  # noqa: ARG002  # of most parts, the fields are enough
        """Return the numbers that the function takes, for q parameters and λ of M₀ = λI.

        They are the numeric fields in the order of their declaration, base classes first; None is
        NaN. Added fields (:func:`dopt.declare.validated_fields.parameter`) are left out: the
        numbers of a class that is derived from theirs keep their places.
        """
        fields = [field for field in self.numeric_fields() if not field.metadata.get("added")]
        values = [getattr(self, field.name) for field in fields]
        return tuple(math.nan if value is None else float(value) for value in values)
