"""D-optimal exploration without linearisation: maximises Definition 1 by gradient ascent."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.policies.base import Array, CustomPolicy, InformationPolicy, Planner
from dopt.policies.search import CandidatePolicy
from dopt.systems.base import System
from dopt.trial_view import TrialView

WIDENING = 4.0
"""Largest factor from the angle of one ascent step to where the next one aims."""

LEAST_ANGLE = 1e-9
"""Smallest angle of an ascent step [rad]."""

DIFFERENCE = 1e-3
"""Change of an input, in γ, over which the predicted state is differentiated."""


@dataclass(frozen=True, kw_only=True)
class GradientDOptimal(CandidatePolicy, InformationPolicy, CustomPolicy):
    """Maximise G_D(u) = log det(M + J(x(u))ᵀ J(x(u))) on the sphere ‖u‖ = γ (Definition 1).

    All learned components count, and x(u) = x_t + dt f_θ(x_t, u) is exact. The value of each
    candidate is computed first; from the best of them, projected gradient ascent follows, along the
    great circle of the slope. With one input the candidates ±γ
    are the whole sphere, and nothing is left to ascend. Proposition 1 approximates this optimum in
    closed form.

    Parameters
    ----------
    candidates : int
        As of :class:`dopt.policies.search.CandidatePolicy`.
    starts : int
        How many of them the ascent starts from.
    iterations : int
        Ascent steps from each start.
    """

    name: ClassVar[str] = "gradient"
    compiled: ClassVar[bool] = True

    starts: int = parameter(2, "inputs", "positive")
    iterations: int = parameter(4, "steps", "positive")

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:  # noqa: ARG002  # one form only
        return "primal"

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002  # nothing is random here
        return GradientPlan(self, system)


class GradientPlan(Planner):
    """The plan of one trial: candidates first, then ascent from the best."""

    def __init__(self, policy: GradientDOptimal, system: System) -> None:
        self._policy, self._candidates = policy, policy.compared_inputs(system)

    def choose(self, view: TrialView) -> Array:
        return optimum(Gain(view), self._candidates, self._policy)


class Gain:
    """G_D(u) - log det M of Definition 1 at the present step of a trial.

    By the determinant lemma it is log det(I + J M⁻¹ Jᵀ), with J at x(u): an r × r matrix.
    """

    def __init__(self, view: TrialView) -> None:
        self._view, self._inverse = view, view.covariance

    def value(self, u: Array) -> float:
        """Return the gain of an input, (m,)."""
        J = self._view.jacobian(self._following(u[None])[0])
        return float(np.linalg.slogdet(np.eye(len(J)) + J @ self._inverse @ J.T)[1])

    def slope(self, u: Array) -> tuple[float, Array]:
        """Return the gain of an input, (m,), and its derivative by it, (m,)."""
        step = DIFFERENCE * self._view.system.gamma * np.eye(len(u))
        x = self._following(u[None])[0]
        along = (self._following(u + step) - self._following(u - step)) / (2.0 * step.max())
        J, change = self._view.jacobian(x), self._view.jacobian_change(x, along)
        spread = self._inverse @ J.T
        S = np.eye(len(J)) + J @ spread
        slopes = [2.0 * np.trace(np.linalg.solve(S, dJ @ spread)) for dJ in change]
        return float(np.linalg.slogdet(S)[1]), np.array(slopes)

    def _following(self, inputs: Array) -> Array:
        """Return the states, (N, d), that the model predicts under inputs, (N, m)."""
        return self._view.following(self._view.states[-1], inputs)


def optimum(gain: Gain, starts: Array, search: GradientDOptimal) -> Array:
    """Return the best input, (m,), found from inputs (C, m) on the sphere."""
    values = np.array([gain.value(u) for u in starts])
    chosen = np.argsort(-values, kind="stable")[: search.starts]
    found = [(values[i], starts[i]) for i in chosen]
    if starts.shape[1] > 1:
        angle = math.pi / len(starts)
        found = [ascend(gain.slope, u, angle, search.iterations) for _, u in found]
    best: Array = found[int(np.argmax([value for value, _ in found]))][1]
    return best


def ascend(
    gain: Callable[[Array], tuple[float, Array]], start: Array, angle: float, iterations: int
) -> tuple[float, Array]:
    """Ascend on the sphere from an input, (m,); return the value where it ends, and the place.

    Each step goes along the great circle of the projected gradient. Its angle is where the secant
    of the slopes along the last circle is zero, and at most half of one that gained nothing.

    Parameters
    ----------
    gain : callable
        From an input, (m,), to its value and the slope, (m,).
    angle : float
        First step [rad].
    """
    u, (value, slope), radius = start, gain(start), float(np.linalg.norm(start))
    for _ in range(iterations):
        tangent = slope - (slope @ u) / radius**2 * u
        length = float(np.linalg.norm(tangent))
        along = radius * tangent / max(length, 1e-300)
        tried = math.cos(angle) * u + math.sin(angle) * along
        # At an optimum the tangent is rounding, which may point off the sphere.
        tried *= radius / np.linalg.norm(tried)
        new_value, new_slope = gain(tried)
        onwards = math.cos(angle) * along - math.sin(angle) * u
        fall = (radius * length - new_slope @ onwards) / angle
        root = WIDENING * angle
        if fall > 0.0:
            root = min(radius * length / float(fall), root)
        if new_value > value:
            u, value, slope, angle = tried, new_value, new_slope, abs(root - angle)
        else:
            angle = min(root, angle / 2.0)
        angle = max(angle, LEAST_ANGLE)
    return value, u
