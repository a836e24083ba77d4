"""Sampling planner: the cross-entropy method over inputs that are held (iCEM)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.algorithm import Score
from dopt.errors import IncompatibleError
from dopt.fields import parameter
from dopt.policies.base import Array, InformationPolicy, check_length
from dopt.systems.base import System

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
    kernel_function: ClassVar[str] = "dopt.kernel.search.sampling.plan"
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

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:  # noqa: ARG002  # one form only
        return "primal"

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:  # noqa: ARG002  # none depends on how many parameters there are
        sizes = (self.lookahead, self.hold, self.stride, self.plans, self.iterations, self.elites)
        return tuple(float(number) for number in (*sizes, self.score, self.task_count))

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

    It searches as :class:`dopt.policies.icem.ICEM`, at step 1 and at the multiples of k.
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
    kernel_function: ClassVar[str] = "dopt.kernel.search.sampling.plan_episodes"

    lookahead: int = parameter(50, "steps", "positive")
    replan_every: int = parameter(50, "steps", "positive")

    def check(self, system: System) -> None:
        super().check(system)
        if self.replan_every > self.lookahead:
            raise IncompatibleError(
                f"policy.replan_every is {self.replan_every} steps, but the plans have "
                f"{self.lookahead}: make it smaller, or policy.lookahead larger."
            )

    def kernel_numbers(self, n_parameters: int, regularization: float) -> tuple[float, ...]:
        numbers = super().kernel_numbers(n_parameters, regularization)
        return *numbers, float(self.replan_every)
