"""Uniform exploration: the next state as far as possible from all states seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dopt.fields import parameter
from dopt.policies.base import ClosedLoop


@dataclass(frozen=True, kw_only=True)
class Uniform(ClosedLoop):
    """Maximise G(u) = Σ_{s≤t} ‖x(u) - x_s‖₂ on the sphere ‖u‖ = γ (section 3).

    The prediction x(u) = x_t + dt f_θ(x_t, u) is affine in u, so G is convex and its maximum over
    the ball lies on the sphere. The gradient ascent u ← γ ∇G(u)/‖∇G(u)‖ then never decreases G
    (M. Journée et al., "Generalized power method", JMLR 11, 2010); it starts from ±γ along each
    input axis, and the best end point is taken. With m = 1 these two points are the sphere.

    Parameters
    ----------
    iterations : int
        Ascent steps from each start.
    """

    name: ClassVar[str] = "uniform"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.policies.uniform.plan"
    reads_inputs: ClassVar[bool] = True

    iterations: int = parameter(8, "steps", "positive")
