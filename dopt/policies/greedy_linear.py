"""Greedy D-optimal identification of linear systems, reference [7] of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.base import Array, ClosedLoop
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox


@dataclass(frozen=True, kw_only=True)
class GreedyLinear(ClosedLoop):
    """Maximise x(u)ᵀ Γ⁻¹ x(u) on the sphere ‖u‖ = γ, with Γ = λI + Σ x_s x_sᵀ over the states seen.

    With x(u) = x̄ + B u and the least-squares estimate in x̄ this is uᵀQu - 2vᵀu with Q = BᵀΓ⁻¹B and
    v = -BᵀΓ⁻¹x̄: for a system that is linear in its state, log det of the information grows most.
    States are measured in the system's feature scales. It goes with ``model=linear_state`` and
    ``learner=recursive_least_squares``; Proposition 1 generalises it, and there chooses the same
    inputs. Reference: M. Blanke and M. Lelarge, "Online greedy identification of linear dynamical
    systems" (CDC 2022).

    Parameters
    ----------
    regularization : float
        λ, the ridge of the least squares as well.
    """

    name: ClassVar[str] = "linear"
    compiled: ClassVar[bool] = False

    regularization: float = parameter(1e-3, bound="positive")

    def check(self, system: System) -> None:
        if not is_linear(system):
            raise IncompatibleError(
                f"policy 'linear' needs dynamics that are linear in state and input, and the state "
                f"itself as features, but env '{system.name}' is not so: choose another policy."
            )


def is_linear(system: System) -> bool:
    """Tell whether f(x, u) adds up over states and inputs, and the features are the whole state."""
    if isinstance(system, BlackBox):
        return False
    seen = sorted(feature.index for feature in system.features)
    if any(f.kind != "identity" for f in system.features) or seen != [*range(system.n_states)]:
        return False
    points = np.random.default_rng(0).standard_normal((3, 2, system.n_states + system.n_inputs))
    return all(_adds_up(system, one, other) for one, other in points)


def _adds_up(system: System, one: Array, other: Array) -> bool:
    d = system.n_states
    whole, first, second = (
        system.derivative(z[:d], z[d:]) for z in (one + 2.0 * other, one, other)
    )
    return bool(np.allclose(whole, first + 2.0 * second, rtol=1e-9, atol=1e-9))
