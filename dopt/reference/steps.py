"""Steps of Algorithm 1 in torch, one by one: plan, learn, and update of the information."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from dopt.errors import SpecificationError
from dopt.policies import DOptimal, Search, TraceLinearized, Uniform
from dopt.policies.base import OpenLoop
from dopt.reference.custom_plugins import observe, planned_inputs, planners_for
from dopt.reference.dynamics import known_flow
from dopt.reference.joint_kalman import JointKalmanLearner
from dopt.reference.learner_registry import batch_learner
from dopt.reference.learning import GaussNewtonLearner, KalmanLearner
from dopt.reference.limits import BatchLimits
from dopt.reference.planner_registry import plan_for
from dopt.reference.planning import best_inputs, drawn_columns, uniform_inputs
from dopt.reference.recorded import Recorded
from dopt.reference.search import searched_inputs
from dopt.reference.sensors import BatchSensors
from dopt.reference.state import BatchState
from dopt.spec.compatibility import is_fresh


class BatchSteps(BatchState):
    """The steps of a batch of trials, whatever comes between them: a simulation or a measurement.

    Call :meth:`prepare` before the first of them.
    """

    def prepare(self, points: Tensor) -> None:
        """Make plans and learners; ``points``, (N, d), are the states of the evaluation."""
        self.planners = planners_for(self.specs)
        self.sensors = BatchSensors(self) if self.system.n_measured else None
        self.learner = batch_learner(self, points, self.sensors)
        self.own_plan = plan_for(self, self.learner)
        if isinstance(self.config.policy, Search) and self.held is not None:
            given = self.config.policy, self.learned, self.held.noise_variance
            self._searched = Recorded(functools.partial(searched_inputs, *given))
        columns = functools.partial(drawn_columns, self.learned, self.project)
        self._columns = Recorded(columns)
        best = functools.partial(best_inputs, self.system.gamma)
        self._best = Recorded(best)
        self._rows = Recorded(self.learned.jacobian)
        limits, self.limits = self.config.limits, None
        if limits and limits.enforced:
            self.limits = BatchLimits(self, limits, self.learner)

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m); the first of a closed-loop policy is random.

        They are those that the policy chooses, unless the limits of the trials demand others.
        """
        u = self._planned(t)
        return self.limits.limited(t, u) if self.limits else u

    def _planned(self, t: int) -> Tensor:
        policy, x = self.config.policy, self.states[:, t]
        if isinstance(policy, OpenLoop) or t == 0:
            return self.open_loop[:, t]
        if self.planners:
            return planned_inputs(self, self.planners, t)
        if self.own_plan is not None:
            return self.own_plan.plan(t)
        if isinstance(policy, Uniform):
            seen = self.states[:, : t + 1]
            return uniform_inputs(self.learned, self.theta, seen, policy.iterations)
        if self.information is None or not isinstance(policy, (Search, DOptimal)):
            raise SpecificationError(
                f"the reference has no plan for policy '{policy.name}': derive its class from "
                f"CustomPolicy, or enter a plan in dopt.reference.planner_registry."
            )
        if isinstance(policy, Search):
            covariance = self.information.covariance()
            searched: Tensor = self._searched(self.theta, covariance, x, self.ties[:, t])
            return searched
        components = self.components[:, t : t + 1]
        if isinstance(policy, TraceLinearized):
            components = torch.arange(self.system.n_learned).to(components).expand(len(x), -1)
        ties, radii = self.ties[:, t], self.radii[:, t]
        columns = self._columns(self.theta, x, components, ties, radii[:, 1:])
        solved = self.information.solve(columns.flatten(1, 2).mT)
        best: Tensor = self._best(columns, solved, ties, radii[:, 0])
        return best

    def observe(self, t: int, dt: float) -> None:
        """Store the accelerations observed from x_t to x_{t+1}, which came dt seconds later.

        Where states are measured with noise, x_{t+1} is estimated first. With the integrator of
        Runge and Kutta, the accelerations are those of :func:`dopt.kernel.loop.observe`.
        """
        if self.sensors:
            self.sensors.estimate(t, dt)
        system, x, u = self.system, self.states[:, t], self.sampled_inputs(t)
        at = x
        if system.integrator != "euler":
            at = 0.5 * (x + self.states[:, t + 1])
        self.sampled_states[:, t] = at
        known = known_flow(system, at, u)
        observed = self._learned_of((self.states[:, t + 1] - x) / dt - known)
        if system.integrator != "euler":
            end = self.learned.next_states(self.theta, x, u, dt)
            value = self.model(self.theta, self.points(at, u).unsqueeze(1)).squeeze(1)
            observed = observed - (self._learned_of((end - x) / dt - known) - value)
        self.targets[:, t] = observed

    def _learned_of(self, values: Tensor) -> Tensor:
        """Return the components that are learned, (n, r), of derivatives of states (n, d)."""
        return values.index_select(1, self.learned_rows)

    def learn(self, t: int) -> None:
        """Update the parameters with the samples up to time t; diverged trials keep theirs.

        Of an ensemble that is the member whose turn it is, and then the first one, whose M stays.
        """
        if self.limits:
            self.limits.note_error(t, self.sampled(t))
        if self.members is None:
            self._learn(t)
            return
        assert isinstance(self.learner, GaussNewtonLearner)
        for turn in (1 + t % (self.members.shape[1] - 1), 0):
            self.theta.copy_(self.members[:, turn])
            self.learner.prior.copy_(self.member_priors[:, turn])
            self._learn(t)
            self.members[:, turn] = self.theta

    def _learn(self, t: int) -> None:
        before = self.theta.clone()
        if isinstance(self.learner, JointKalmanLearner):
            self.learner.filter(t)
        else:
            self.learner.learn(self.sampled(slice(0, t + 1)), self.targets[:, : t + 1])
        self.theta.copy_(torch.where(self.diverged, before, self.theta))

    @property
    def parameters_of_model(self) -> Tensor:
        """Parameters of the model, (n, q), those of the members one after the other."""
        return self.theta if self.members is None else self.members.flatten(1)

    def sampled(self, steps: int | slice) -> Tensor:
        """Return the points at which the accelerations of some steps were observed, (n, ..., ·)."""
        return self.points(self.sampled_states[:, steps], self.sampled_inputs(steps))

    def sampled_inputs(self, steps: int | slice) -> Tensor:
        """Return the inputs that belong to the accelerations of some steps, (n, ..., m)."""
        return self.sensors.sampled_inputs(steps) if self.sensors else super().sampled_inputs(steps)

    def rows(self, steps: slice) -> Tensor:
        """Return J at the samples of some steps and the current parameters, (n, N, r, s).

        They are those in the space of M.
        """
        return self.project(self._rows(self.theta, self.sampled(steps)))

    def inform(self, t: int) -> None:
        """Add JᵀJ at (x_t, u_t) and the parameters after the learning step of time t.

        A learner that shares M has done so in its learning step. Fresh information has the rows of
        all states at these parameters instead.
        """
        observe(self, self.planners, t)
        shared = isinstance(self.learner, KalmanLearner | JointKalmanLearner)
        if self.information is not None and not shared:
            policy = self.config.policy
            if is_fresh(policy) and (t + 1) % policy.refresh_every == 0:
                self._sum_anew(t)
            else:
                self.information.add(self.rows(slice(t, t + 1)).squeeze(1))
        if self.own_plan is not None:
            self.own_plan.inform(t)

    def _sum_anew(self, t: int) -> None:
        """Make M = λI + Σ JᵀJ over x_0 ... x_t at the current parameters.

        θ is NaN afterwards, which ends the trial as diverged, where rounding has left the sum
        indefinite or its inverse is not finite.
        """
        assert self.held is not None
        assert self.information is not None
        J = self.rows(slice(0, t + 1)).flatten(1, 2)
        prior = self.held.regularization * torch.eye(J.shape[-1]).to(J)
        self.information.replace(prior + J.mT @ J)
        lost = ~self.information.covariance().diagonal(dim1=1, dim2=2).isfinite().all(dim=1)
        self.theta.masked_fill_(lost.unsqueeze(1) & ~self.diverged, torch.nan)
