"""Searches for the best of some candidate inputs or plans, by several criteria.

Finite sets of candidates, and the sampling planner, which is the cross-entropy method over inputs
that are held (iCEM).
"""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from dataclasses import dataclass
from statistics import NormalDist
from typing import ClassVar

import numpy as np

from dopt.algorithm import Score
from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.base import Array, InformationPolicy, Policy, check_length, on_sphere
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox
from dopt.systems.properties import eigenmode

LARGEST_REPELLED = 256
"""More points than these stay where the sequence has them: repulsion takes their number squared."""

_REPULSIONS = 400


@functools.lru_cache(maxsize=16)
def sphere_directions(n_inputs: int, count: int) -> Array:
    """Return unit vectors, (C, m), spread well over the sphere; the same at every call.

    For m = 1 these are ±1, for m = 2 equal angles from the first axis. Otherwise points of a
    low-discrepancy sequence (M. Roberts, "The unreasonable effectiveness of quasirandom sequences",
    2018) repel each other as charges do.

    Parameters
    ----------
    n_inputs : int
        m.
    count : int
        C, odd or even. One input has two directions, whatever the count.
    """
    if n_inputs == 1:
        return np.array([[1.0], [-1.0]])
    if n_inputs == 2:
        angles = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = _quasirandom(n_inputs, count)
    return _repelled(points) if count <= LARGEST_REPELLED else points


def _quasirandom(m: int, count: int) -> Array:
    """Return points on the unit sphere, (count, m), from a Kronecker sequence in the cube."""
    root = 2.0
    for _ in range(50):  # the positive root of x^(m + 1) = x + 1
        root = (1.0 + root) ** (1.0 / (m + 1))
    cube = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, m + 1))) % 1.0
    return on_sphere(np.vectorize(NormalDist().inv_cdf)(cube), 1.0)


def _repelled(points: Array) -> Array:
    """Return points on the unit sphere, (C, m), moved apart by forces of one over distance²."""
    count, m = points.shape
    for i in range(_REPULSIONS):
        gaps = points[:, None] - points
        distances = np.linalg.norm(gaps, axis=-1) + np.eye(count)
        force = (gaps / distances[..., None] ** 3).sum(axis=1)
        force -= (force * points).sum(axis=1, keepdims=True) * points
        largest = np.linalg.norm(force, axis=1).max() + 1e-300
        step = (1 - i / _REPULSIONS) * count ** (-1 / (m - 1))
        points = on_sphere(points + step / (2 * largest) * force, 1.0)
    return points


@dataclass(frozen=True, kw_only=True)
class CandidatePolicy(Policy):
    """A policy that compares candidate inputs.

    Parameters
    ----------
    candidates : int
        Inputs spread over the sphere ‖u‖ = γ; with one input there are two, ±γ.
    """

    candidates: int = parameter(16, "inputs", "positive")

    def compared_inputs(self, system: System) -> Array:
        """Return the candidates, (C, m), with norm γ."""
        return system.gamma * sphere_directions(system.n_inputs, self.candidates)


@dataclass(frozen=True, kw_only=True)
class Search(CandidatePolicy, InformationPolicy):
    """Roll the learned model along every plan of a finite set and take the best plan's first input.

    From x_t the model runs x ← x + dt f_θ(x, u) without linearisation. The rows J at the states of
    the path, all r learned components of each, are what the plan would add to M; a score says what
    they are worth. The plan is made again at each step. Among plans of equal score a random
    direction decides, as it does where every path leaves the bounds of a state: such a path has no
    score. M⁻¹ is held as a q × q matrix.

    With a time budget plans are scored one after the other until it is spent, opposite inputs in
    turn from a random one on, and the best so far is taken: the result then depends on the clock
    and on the machine. Without one it is deterministic. What all plans share, such as a copy of
    M⁻¹, and the first plan are not cut short: a budget below that is exceeded, and the first input
    is random.

    Parameters
    ----------
    candidates : int
        As of :class:`dopt.policies.search.CandidatePolicy`.
    budget_us : float
        Time for the search of one step [µs]; 0 is no limit. The first plan is always scored.
    """

    kernel_function: ClassVar[str] = "dopt.kernel.search.plan"
    reads_inputs: ClassVar[bool] = True

    budget_us: float = parameter(0.0, "µs", "nonnegative")

    @property
    @abstractmethod
    def score(self) -> Score:
        """Criterion of a plan."""

    def steps(self, system: System) -> int:
        """Return the number of steps H of a plan: one in which the input acts."""
        return 1 + system.lead_steps


@dataclass(frozen=True, kw_only=True)
class Exact(Search):
    """Maximise log det(I + J M⁻¹ Jᵀ), the growth of log det M, with J at x_t + dt f_θ(x_t, u).

    The objective of Definition 1 for one step, which D-optimal exploration linearises for one
    component (Proposition 1), over candidate inputs. Reference: V. Fedorov, "Theory of optimal
    experiments" (1972).
    """

    name: ClassVar[str] = "exact"
    compiled: ClassVar[bool] = True
    score: ClassVar[Score] = Score.JOINT


@dataclass(frozen=True, kw_only=True)
class Trace(Search):
    """Maximise tr(J M⁻¹ Jᵀ), the sum of all components' variances, at x_t + dt f_θ(x_t, u).

    The first-order term of log det(I + J M⁻¹ Jᵀ). It also is the objective of Algorithm 2 summed
    over the components, without linearisation in u; :mod:`dopt.policies.d_optimal` has that.
    """

    name: ClassVar[str] = "trace"
    compiled: ClassVar[bool] = True
    score: ClassVar[Score] = Score.TRACE


@dataclass(frozen=True, kw_only=True)
class AOptimal(Search):
    """Maximise the decrease of tr M⁻¹ by the rows J at x_t + dt f_θ(x_t, u).

    With V = J M⁻¹ it is tr((I + V Jᵀ)⁻¹ V Vᵀ) (Woodbury identity). Reference: F. Pukelsheim,
    "Optimal design of experiments" (1993), chapter 6.
    """

    name: ClassVar[str] = "a_optimal"
    compiled: ClassVar[bool] = True
    score: ClassVar[Score] = Score.A


_START_SEED = 1_712


@dataclass(frozen=True, kw_only=True)
class EOptimal(Search):
    """Maximise the smallest eigenvalue of M + JᵀJ, with J at x_t + dt f_θ(x_t, u).

    Its inverse is the largest eigenvalue of (M + JᵀJ)⁻¹. It is taken by Rayleigh and Ritz in a
    block Krylov space of M⁻¹, the same for all candidates, from r + 1 fixed vectors: a step adds r
    rows, so that an eigenvalue of larger multiplicity is seen to stay. As long as fewer than q rows
    are known that is 1/λ whatever the input: the criterion is blind, and chance decides.
    Reference: Y. Saad, "Numerical methods for large eigenvalue problems", 2nd ed., chapter 6.

    Parameters
    ----------
    subspace : int
        Dimensions of the Krylov space; with q of them the eigenvalue is exact.
    """

    name: ClassVar[str] = "e_optimal"
    compiled: ClassVar[bool] = True
    score: ClassVar[Score] = Score.E

    subspace: int = parameter(32, "dimensions", "positive")

    def starts(self, n_parameters: int, n_learned: int) -> Array:
        """Return the vectors that span the Krylov space at first, (≤ r + 1, q)."""
        count = min(n_learned + 1, self.subspace, n_parameters)
        return np.random.default_rng(_START_SEED).standard_normal((count, n_parameters))


@dataclass(frozen=True, kw_only=True)
class TaskOptimal(Search):
    """Maximise the decrease of the predictive variance summed over states that matter to a task.

    With G the rows of the Jacobian at these states and V = J M⁻¹, the decrease by the rows J at
    x_t + dt f_θ(x_t, u) is tr((I + V Jᵀ)⁻¹ V GᵀG Vᵀ): V-optimal design. The states are drawn once
    for all from the evaluation box or the reachable set, with weights exp(-δ²/2) that fall with
    the distance δ to the goal (:func:`dopt.evaluation.task_states`). Reference:
    A. Atkinson, A. Donev and R. Tobias, "Optimum experimental designs" (2007), chapter 10.

    Parameters
    ----------
    states : {"grid", "reachable"}
        Where the states are drawn from: the box of the evaluation grid, or the states that the true
        system visits under strong inputs, which takes the true system to know.
    count : int
        Number of states.
    goal : tuple of float
        State of the task, in its d components; empty weighs all states alike.
    radius : float
        Distance to the goal at which the weight is e^(-1/2), in half-widths of the grid.
    """

    name: ClassVar[str] = "task"
    compiled: ClassVar[bool] = True
    score: ClassVar[Score] = Score.TASK

    states: str = parameter("grid", choices=("grid", "reachable"))
    count: int = parameter(32, "states", "positive")
    goal: tuple[float, ...] = parameter(())
    radius: float = parameter(0.5, "half-widths", "positive")

    def check(self, system: System) -> None:
        if self.states == "reachable" and isinstance(system, BlackBox):
            raise IncompatibleError(
                f"policy.states is 'reachable', but where env '{system.name}' can be driven is not "
                f"known without its equations: set it to grid."
            )
        if self.goal and len(self.goal) != system.n_states:
            raise IncompatibleError(
                f"policy.goal has {len(self.goal)} entries, but a state of env '{system.name}' has "
                f"{system.n_states}: give one for each of them, or none."
            )


PERIOD_SHARE = 0.6
STEPS_WITHOUT_PERIOD = 10
STATES_OF_A_PATH = 5


@dataclass(frozen=True, kw_only=True)
class Lookahead(Search):
    """Score "hold u" and "hold u for H/2 steps, then u'" over all candidates u and u'.

    One step is blind where an input acts through an integrator: a rotation moves a quadrotor
    sideways only later. The first input of the best of the C² plans is applied, and the plan is
    made again at the next step.

    Parameters
    ----------
    lookahead : int or None
        H; None takes 0.6 periods of the least damped oscillation about the stable equilibrium, and
        10 steps without an oscillation. The period is the true system's, as in the periodic
        policy: give H where it is unknown.
    criterion : {"joint", "sum"}
        ``joint`` is log det(I + J M⁻¹ Jᵀ) of all rows along the path, ``sum`` the same of each
        state's rows alone, summed over the path.
    stride : int or None
        Every how many steps a state's rows are taken; in ``joint`` each counts so many times. None
        takes a fifth of the plan's steps: neighbouring rows are nearly the same.
    """

    name: ClassVar[str] = "lookahead"
    compiled: ClassVar[bool] = True

    candidates: int = parameter(8, "inputs", "positive")
    lookahead: int | None = parameter(None, "steps", "positive")
    criterion: str = parameter("sum", choices=("joint", "sum"))
    stride: int | None = parameter(None, "steps", "positive")

    def check(self, system: System) -> None:
        if self.lookahead is not None:
            check_length("policy.lookahead", self.lookahead, system)
        if self.stride is not None and self.stride > self.steps(system):
            raise IncompatibleError(
                f"policy.stride is {self.stride} steps, but the plans have {self.steps(system)}: "
                f"make it smaller, or policy.lookahead larger."
            )

    @property
    def score(self) -> Score:
        return Score[self.criterion.upper()]

    def steps(self, system: System) -> int:
        if self.lookahead is not None:
            return self.lookahead
        mode = eigenmode(system)
        if mode is None:
            return STEPS_WITHOUT_PERIOD
        return max(1, round(PERIOD_SHARE * 2 * math.pi / mode.frequency / system.dt))

    def stride_of(self, system: System) -> int:
        """Return every how many steps of a plan a state's rows are taken."""
        if self.stride is not None:
            return self.stride
        return max(1, self.steps(system) // STATES_OF_A_PATH)


BLOCKS = 32
"""Steps with random numbers of their own; later steps use the same numbers again."""


@dataclass(frozen=True, kw_only=True)
class ICEM(InformationPolicy):
    """Search for the best sequence of held inputs by the cross-entropy method.

    A plan is a sequence of inputs of norm γ, each held for some steps. The model rolls all plans of
    an iteration together. The best few, the elites, set mean and spread of the normal distribution
    from which the next iteration draws; they compete again with its plans. The first input of the
    best plan is applied, and the search of the next step starts from the mean and the elites of
    this one. Reference: C. Pinneri et al., "Sample-efficient cross-entropy method for real-time
    planning" (2020).

    The score of a plan is the mean of its scores over all horizons up to H, so that what is near
    counts more. With ``domain`` "box" the rows of a state outside the evaluation box are multiplied
    by exp(-δ²/2), δ its distance from the box in quarters of its half-widths: what is learned there
    is of no use inside, and takes the network's capacity.

    What a plan is worth follows from the covariance J M⁻¹ Jᵀ of the accelerations along its path.
    It is estimated from ``samples`` draws of the parameters from the normal distribution with the
    covariance M⁻¹ about θ, so that it costs s products for each state and not q.

    Parameters
    ----------
    lookahead : int
        Steps H of a plan.
    hold : int
        Steps for which an input is held.
    stride : int
        Every how many steps a state's rows are taken; in ``joint`` and ``task`` each counts so
        many times.
    plans : int
        Plans drawn in an iteration.
    iterations : int
        Iterations of a step.
    elites : int
        Plans that an iteration hands on.
    criterion : {"joint", "sum", "variance", "task"}
        ``joint`` is log det(I + J M⁻¹ Jᵀ) of all rows along the path, ``sum`` the same of each
        state's rows alone, summed over the path (the criterion of B. Sukhija et al.,
        "Optimistic active exploration of dynamical systems", 2023), ``variance`` the trace
        of J M⁻¹ Jᵀ (as for ensembles), and ``task`` the decrease of the variance summed over
        states of the evaluation box (:class:`dopt.policies.TaskOptimal`).
    domain : {"everywhere", "box"}
        Where a state's rows count.
    samples : int
        Draws of the parameters s.
    count : int
        States of the evaluation box in ``task``; others at each step.
    """

    name: ClassVar[str] = "icem"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.sampling.plan"
    reads_inputs: ClassVar[bool] = True

    lookahead: int = parameter(60, "steps", "positive")
    hold: int = parameter(10, "steps", "positive")
    stride: int = parameter(10, "steps", "positive")
    plans: int = parameter(48, "plans", "positive")
    iterations: int = parameter(3, "iterations", "positive")
    elites: int = parameter(6, "plans", "positive")
    criterion: str = parameter("joint", choices=("joint", "sum", "variance", "task"))
    domain: str = parameter("everywhere", choices=("everywhere", "box"))
    samples: int = parameter(32, "draws", "positive")
    count: int = parameter(24, "states", "positive")

    def check(self, system: System) -> None:
        check_length("policy.lookahead", self.lookahead, system)
        if self.stride > self.lookahead:
            raise IncompatibleError(
                f"policy.stride is {self.stride} steps, but the plans have {self.lookahead}: make "
                f"it smaller, or policy.lookahead larger."
            )
        if self.elites > self.plans:
            raise IncompatibleError(
                f"policy.elites is {self.elites}, but an iteration draws {self.plans} plans: make "
                f"it smaller, or policy.plans larger."
            )

    @property
    def score(self) -> Score:
        """Criterion of a plan."""
        return Score.TRACE if self.criterion == "variance" else Score[self.criterion.upper()]

    @property
    def segments(self) -> int:
        """Number K of inputs in a plan: the first may have been applied for some steps already."""
        return -(-self.lookahead // self.hold) + 1

    @property
    def task_count(self) -> int:
        """Number of states of the evaluation box at each step, 0 where the criterion needs none."""
        return self.count if self.criterion == "task" else 0

    def memory_size(self, system: System, n_parameters: int) -> int:  # noqa: ARG002  # of the plans alone
        return (1 + self.elites) * self.segments * system.n_inputs

    def draw_plans(self, system: System, rng: np.random.Generator) -> Array:
        """Return standard normal numbers, (blocks, iterations, plans, K, m)."""
        blocks = min(BLOCKS, system.horizon)
        size = (blocks, self.iterations, self.plans, self.segments, system.n_inputs)
        return rng.standard_normal(size)

    def draw_parameters(self, n_parameters: int, rng: np.random.Generator) -> Array:
        """Return standard normal numbers, (q, s), that give the draws of the parameters."""
        return rng.standard_normal((n_parameters, self.samples))


@dataclass(frozen=True, kw_only=True)
class Episodic(ICEM):
    """Search for the best sequence of held inputs, and carry it out before the next search.

    It searches as :class:`dopt.policies.search.ICEM`, at step 1 and at the multiples of k.
    Between two searches the best plan is followed, whatever is observed. With k = H
    whole plans are carried out, as by the episodic D-optimal agent of M. Blanke and M. Lelarge,
    "FLEX: an adaptive exploration algorithm for nonlinear systems" (2023); with k < H and
    ``criterion`` "joint" it is the planner of M. Schultheis et al., "Receding horizon curiosity"
    (2019), with other models. Where every plan of a search leaves the bounds, the first input after
    it is random.

    Parameters
    ----------
    lookahead : int
        Steps H of a plan.
    replan_every : int
        Steps k from one search to the next, at most H.
    """

    name: ClassVar[str] = "episodic"
    compiled: ClassVar[bool] = True
    kernel_function: ClassVar[str] = "dopt.kernel.sampling.plan_episodes"

    lookahead: int = parameter(50, "steps", "positive")
    replan_every: int = parameter(50, "steps", "positive")

    def check(self, system: System) -> None:
        super().check(system)
        if self.replan_every > self.lookahead:
            raise IncompatibleError(
                f"policy.replan_every is {self.replan_every} steps, but the plans have "
                f"{self.lookahead}: make it smaller, or policy.lookahead larger."
            )
