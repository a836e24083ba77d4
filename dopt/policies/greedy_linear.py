"""Greedy D-optimal identification of linear systems, reference [7] of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.base import Array, CustomPolicy, Planner
from dopt.sphere import sphere_maximizer
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox
from dopt.trial_view import TrialView


@dataclass(frozen=True, kw_only=True)
class GreedyLinear(CustomPolicy):
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
    compiled: ClassVar[bool] = True

    regularization: float = parameter(1e-3, bound="positive")

    def check(self, system: System) -> None:
        if not is_linear(system):
            raise IncompatibleError(
                f"policy 'linear' needs dynamics that are linear in state and input, and the state "
                f"itself as features, but env '{system.name}' is not so: choose another policy."
            )

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002  # ties are broken by the trial's
        return GreedyLinearPlan(self, system)


class GreedyLinearPlan(Planner):
    """The plan of one trial: uᵀQu - 2vᵀu with states in feature scales, and the Γ so far."""

    def __init__(self, policy: GreedyLinear, system: System) -> None:
        self._system, self._gram = system, policy.regularization * np.eye(system.n_states)

    def choose(self, view: TrialView) -> Array:
        system, still = self._system, np.zeros((1, self._system.n_inputs))
        center = system.featurize(view.following(view.states[-1], still))[0]
        B = system.featurize(view.input_matrix(view.states[0]).T).T
        solved = np.linalg.solve(self._gram, B)
        Q, v = B.T @ solved, -(solved.T @ center)
        if not np.isfinite(v).all():
            return np.full(system.n_inputs, np.nan)  # the model has overflowed
        if len(v) == 1:
            up = v[0] < 0.0 or (v[0] == 0.0 and view.tie[0] > 0.0)
            return np.array([system.gamma if up else -system.gamma])
        best: Array = sphere_maximizer(Q, v, system.gamma, view.tie)
        return best

    def observe(self, view: TrialView) -> None:
        z = self._system.featurize(view.sampled[-1:])[0]
        self._gram += np.outer(z, z)


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
