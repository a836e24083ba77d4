"""A trial again, looked at on the way: what the model knew after some of its steps."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError
from dopt.spec import TrialSpec

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Replay:
    """What a trial looked like on the way.

    Attributes
    ----------
    steps : (k,)
        Numbers of steps done; past a divergence there are none.
    parameters : (k, q)
        Parameters of the model after each of them.
    states : (T + 1, d)
        All states, to compare with stored ones.
    """

    steps: npt.NDArray[np.int64]
    parameters: Array
    states: Array


def replay(spec: TrialSpec, steps: Sequence[int]) -> Replay:
    """Run a trial in the kernel and note the parameters after ascending numbers of steps.

    Raises
    ------
    SpecificationError
        If the numbers do not ascend or lie beyond the horizon.
    """
    from dopt.kernel.run import KernelTrial

    if any(a >= b for a, b in itertools.pairwise(steps)):
        raise SpecificationError(f"the steps {list(steps)} do not ascend: sort them.")
    trial = KernelTrial(spec)
    seen: list[int] = []
    parameters: list[Array] = []
    for step in steps:
        trial.advance(step)
        if trial.diverged_at is not None:
            break
        seen.append(step)
        parameters.append(trial.state.theta.copy())
    q = spec.model.n_parameters(spec.system)
    return Replay(
        np.array(seen, dtype=np.int64),
        np.array(parameters).reshape(-1, q),
        trial.record.states.copy(),
    )
