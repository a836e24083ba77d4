"""D-optimal exploration: Algorithm 2, an oracle, ascents, linear systems; uniform exploration."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.base import Array, CustomPolicy, InformationPolicy, Planner, Policy
from dopt.policies.search import CandidatePolicy
from dopt.sphere import sphere_maximizer
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox
from dopt.trial_view import TrialView
from dopt.types import Buckets, Signs

SMALL_PRIMAL = 600
EQUAL_COST = 0.9
"""Parameters for each row of the whole trial at which primal and dual steps take the same time."""

LARGEST_PRIMAL = 23_000
"""Most parameters for which ``auto`` holds M⁻¹, which then has 4 GB, on any machine."""

LARGE_DUAL = 4000
_SKETCH_SEED = 1_406_2


@dataclass(frozen=True, kw_only=True)
class DOptimal(InformationPolicy):
    """Maximise the linearised one-step information gain of one learned component (equation 7).

    The component k is drawn uniformly among the learned ones at each step.

    M is held in one of three forms. ``primal`` keeps M⁻¹, q × q. ``dual`` keeps the Gram matrix of
    the N rows seen and never builds a q × q matrix; it chooses the same inputs. ``sketch`` projects
    the gradients to ``sketch_size`` random dimensions: bounded memory for wide networks over long
    horizons, an approximation. ``auto`` takes the cheapest exact form, and the sketch when neither
    fits.

    Parameters
    ----------
    regularization : float
        λ.
    form : {"auto", "primal", "dual", "sketch"}
        Representation of the information matrix.
    sketch_size : int
        Dimensions of the sketch.
    """

    name: ClassVar[str] = "d_optimal"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.policies.plan_d_optimal"
    reads_inputs: ClassVar[bool] = True

    form: str = parameter("auto", choices=("auto", "primal", "dual", "sketch"))
    sketch_size: int = parameter(256, "dimensions", "positive")
    all_components: ClassVar[bool] = False

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:  # noqa: ARG002  # of no use here
        return (float(self.all_components),)

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:
        """Return the form for q parameters and N rows in the whole trial.

        The primal form costs about q² a step, the dual one about N²/3 on average over the trial;
        they were measured to take the same time at q = 0.9 N. Either is refused where it is too
        large for the memory of a usual machine.
        """
        if self.form != "auto":
            return self.form
        if self.information == "fresh":
            return "primal"
        if n_parameters <= min(max(SMALL_PRIMAL, EQUAL_COST * n_rows), LARGEST_PRIMAL):
            return "primal"
        return "dual" if n_rows <= LARGE_DUAL else "sketch"


def count_sketch(n_parameters: int, size: int) -> tuple[Buckets, Signs]:
    """Return the bucket, (q,), and the sign, (q,), of every parameter; the same for all trials."""
    rng = np.random.default_rng(_SKETCH_SEED)
    buckets = rng.integers(size, size=n_parameters).astype(np.uint32)
    return buckets, rng.choice([-1.0, 1.0], size=n_parameters).astype(np.int8)


@dataclass(frozen=True, kw_only=True)
class TraceLinearized(DOptimal):
    """Maximise the sum over all components k of equation 7's objective on the sphere.

    The quadratic problems of the components add up to one of the same kind, so that nothing has to
    be drawn and nothing but the linearisation is approximate.
    """

    name: ClassVar[str] = "trace_linearized"
    compiled: ClassVar[bool] = True
    all_components: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class Oracle(DOptimal):
    """D-optimal inputs for the physical parametrisation, learned by least squares (section 3).

    It goes with ``model=linear`` and ``learner=recursive_least_squares``.

    Parameters
    ----------
    regularization : float
        λ, the ridge of the least squares as well.
    """

    name: ClassVar[str] = "oracle"
    compiled: ClassVar[bool] = True

    regularization: float = parameter(1e-6, bound="positive")

    def check(self, system: System) -> None:
        if not system.linear_parameters:
            raise IncompatibleError(
                f"policy 'oracle' needs dynamics that are linear in unknown parameters, but env "
                f"'{system.name}' declares none: choose another policy."
            )


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

    def planner(self, system: System, rng: np.random.Generator) -> Planner:  # noqa: ARG002  # nothing is random here
        return GradientPlan(self, system)


class GradientPlan(Planner):
    """The plan of one trial: candidates first, then ascent from the best."""

    def __init__(self, policy: GradientDOptimal, system: System) -> None:
        self._policy, self._candidates = policy, policy.compared_inputs(system)

    def choose(self, view: TrialView) -> Array:
        gain, starts, policy = Gain(view), self._candidates, self._policy
        values = np.array([gain.value(u) for u in starts])
        chosen = np.argsort(-values, kind="stable")[: policy.starts]
        found = [(values[i], starts[i]) for i in chosen]
        if starts.shape[1] > 1:
            angle = math.pi / len(starts)
            found = [ascend(gain.slope, u, angle, policy.iterations) for _, u in found]
        best: Array = found[int(np.argmax([value for value, _ in found]))][1]
        return best


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
        """Return the states, (N, d), that the model predicts when inputs, (N, m), have acted."""
        return self._view.held(inputs, 1 + self._view.system.lead_steps)


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
        return best_on_sphere(Q, v, view.tie, system.gamma)

    def observe(self, view: TrialView) -> None:
        z = self._system.featurize(view.sampled[-1:])[0]
        self._gram += np.outer(z, z)


def best_on_sphere(Q: Array, v: Array, tie: Array, gamma: float) -> Array:
    """Return the maximiser of uᵀQu - 2vᵀu on ‖u‖ = γ, (m,); NaN where a model has overflowed."""
    if not (np.isfinite(Q).all() and np.isfinite(v).all()):
        return np.full_like(v, np.nan)
    if len(v) == 1:
        up = v[0] < 0.0 or (v[0] == 0.0 and tie[0] > 0.0)
        return np.array([gamma if up else -gamma])
    best: Array = sphere_maximizer(Q, v, gamma, tie)
    return best


def is_linear(system: System) -> bool:
    """Return True if f(x, u) is linear and the features are the whole state."""
    if isinstance(system, BlackBox):
        return False
    seen = sorted(feature.index for feature in system.features)
    if any(f.kind != "identity" for f in system.features) or seen != [*range(system.n_states)]:
        return False
    points = np.random.default_rng(0).standard_normal((3, 2, system.n_states + system.n_inputs))
    d = system.n_states
    for one, other in points:
        sums = one + 2.0 * other, one, other
        whole, first, second = (system.derivative(z[:d], z[d:]) for z in sums)
        if not np.allclose(whole, first + 2.0 * second, rtol=1e-9, atol=1e-9):
            return False
    return True


@dataclass(frozen=True, kw_only=True)
class Uniform(Policy):
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
    kernel_function: ClassVar[str] = "dopt.kernel.policies.plan_uniform"
    reads_inputs: ClassVar[bool] = True

    iterations: int = parameter(8, "steps", "positive")
