"""D-optimal exploration (Algorithm 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.fields import quantity
from dopt.policies.base import ClosedLoop


@dataclass(frozen=True, kw_only=True)
class DOptimal(ClosedLoop):
    """Maximise the linearised one-step information gain of one learned component (equation 7).

    The component k is drawn uniformly among the learned ones at each step. The first input is
    uniform on the sphere. M₀ = λI, and M_{t+1} = M_t + JᵀJ with J at (x_t, u_t) and the parameters
    after the learning step of time t.

    Parameters
    ----------
    regularization : float
        λ.
    """

    name: ClassVar[str] = "d_optimal"

    regularization: float = quantity(1e-3, bound="positive")
