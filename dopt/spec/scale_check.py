"""Size of the learned accelerations of a user's own system, compared with what a network learns."""

from __future__ import annotations

import functools
import warnings

import numpy as np

from dopt.errors import ScaleWarning
from dopt.learning import Learner
from dopt.models import MLP, Model
from dopt.policies import Policy
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox
from dopt.types import Array

LARGEST = 100.0
"""Root mean square of the accelerations over the grid up to which a network learns them well.

Those of the shipped systems are 2 to 60 in their units.
"""

SMALLEST = 0.05

WEAKEST = 0.1
"""λ below which a filter over state and parameters does not learn."""


@functools.lru_cache(maxsize=64)
def warn_of_scale(system: System, model: Model) -> None:
    """Warn where the accelerations are of another size than the outputs of a network.

    Weights begin at about 1 and move by the learning rate at each step, in whatever unit the
    accelerations are: in one in which they are in thousands, most of the error is left at the end.
    """
    if isinstance(system, BlackBox) or not isinstance(model, MLP):
        return
    values = system.learned(system.grid())
    warn_of_sizes(system, np.sqrt(np.mean(values**2, axis=0)), "over the evaluation grid")


@functools.lru_cache(maxsize=64)
def warn_of_prior(policy: Policy, model: Model, learner: Learner) -> None:
    """Warn where a filter over state and parameters begins with weights that may be anything.

    Its prediction is then as uncertain from the first step on, and its linearisation wrong.
    """
    regularization = getattr(policy, "regularization", None)
    if not (learner.estimates_states and isinstance(model, MLP)) or regularization is None:
        return
    if regularization < WEAKEST:
        warnings.warn(
            f"policy.regularization is {regularization:g}, which gives each initial parameter the "
            f"variance {1 / regularization:.3g}, but learner '{learner.name}' needs one of about "
            f"1/3: set policy.regularization to 3.",
            ScaleWarning,
            stacklevel=2,
        )


def warn_of_sizes(system: System, sizes: Array, where: str, first: str = "") -> None:
    """Warn of each learned acceleration whose size, (r,), a network does not learn well.

    ``first`` is advice that goes before that on its unit.
    """
    for row, size in zip(system.learned_rows, sizes, strict=True):
        if size > LARGEST or 0 < size < SMALLEST:
            warnings.warn(
                f"The learned acceleration of {system.state_labels[row]} in env '{system.name}' "
                f"has a root mean square of {size:.3g} {where}, but a network learns one of "
                f"{SMALLEST:g} to {LARGEST:g} well: {first}measure that state in a unit about "
                f"{size:.1g} times as large.",
                ScaleWarning,
                stacklevel=2,
            )
