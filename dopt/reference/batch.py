"""Algorithm 1 in torch for the trials of one configuration, which take each step together.

A batch of one is advanced in pieces, or by steps between which a plant is measured.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from dopt.control.task import Feedback
from dopt.custom_planner import custom_planner, custom_updater
from dopt.errors import SpecificationError
from dopt.evaluation import evaluation_set, rates
from dopt.learning import Adam
from dopt.learning.base import CustomLearner, check_update
from dopt.policies import DOptimal, InformationPolicy, Uniform
from dopt.policies.base import OpenLoop, check_choice
from dopt.policies.d_optimal import best_on_sphere, count_sketch
from dopt.randomness import draw, episode_seed
from dopt.reference.models import (
    BatchInformation,
    BatchModel,
    Module,
    NetworkFunction,
    TrialInformation,
    d_optimal_inputs,
    flat,
    gradients_and_changes,
    input_matrix,
    jacobian,
    known_flow,
    model_function,
    model_states,
    next_states,
    planning_columns,
    quadratic_problem,
    true_accelerations,
    uniform_inputs,
)
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from dopt.systems.base import feature_values, next_state
from dopt.systems.black_box import BlackBox, new_start
from dopt.systems.properties import STEP
from dopt.trial_view import TrialView
from dopt.types import Array, Scalar

COLUMNS = ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us")


class BatchSteps:
    """The steps of n trials in torch, whatever comes between them: a simulation or a measurement.

    Parameters
    ----------
    specs : sequence of TrialSpec
        Trials that differ in the seed alone.
    device : str
        Torch device, ``"cpu"`` or ``"cuda"``.

    Attributes
    ----------
    model : callable
        a_θ of the batch (:data:`dopt.reference.models.BatchModel`).
    theta : (n, q) tensor
        Parameters.
    states, inputs, targets : (n, T + 1, d), (n, T, m), (n, T, r) tensors
        Visited states, applied inputs and observed accelerations; NaN where no trial has come yet.
    sampled_states : (n, T, d) tensor
        States at which the accelerations were observed.
    sampled_points : (n, T, ...) tensor
        What the model is a function of, there.
    information : BatchInformation or None
        M in the space to which ``project`` maps gradients, (..., q).
    diverged : (n, 1) tensor
        Whether a trial has ended.
    planners : list of Planner
        The plan of each trial where the policy is written in numpy.
    learner : object
        What takes the learning step of the batch.
    noise, open_loop, ties, components : tensors
        Numbers of :class:`dopt.randomness.Draws` with the trials along the first axis.

    Raises
    ------
    SpecificationError
        If the trials belong to different configurations.
    """

    information_kind: ClassVar[type[BatchInformation]] = BatchInformation

    def __init__(self, specs: Sequence[TrialSpec], device: str = "cpu") -> None:
        if len({spec.config_key for spec in specs}) != 1:
            raise SpecificationError(
                f"{len(specs)} trials of different configurations were given, but the trials "
                f"of a batch may differ in the seed alone: run one batch for each configuration."
            )
        self.specs, self.device = list(specs), device
        self.system, self.config = specs[0].system, specs[0].config
        draws = [draw(spec) for spec in specs]
        self.noise = self.tensor(np.stack([d.noise for d in draws]))
        self.open_loop = self.tensor(np.stack([d.inputs for d in draws]))
        self.ties = self.tensor(np.stack([d.ties for d in draws]))
        self.components = torch.tensor(np.stack([d.components for d in draws]), device=device)
        self.model = model_function(self.system, self.config.model, device)
        self.theta = self.tensor(np.stack([d.weights for d in draws]))
        self._allocate()
        self._hold_information()
        plans = (custom_planner(spec) for spec in self.specs)
        self.planners = [plan for plan in plans if plan is not None]
        learner, policy = self.config.learner, self.config.policy
        self.learner: AdamLearner | NumpyLearner | LeastSquaresLearner
        if isinstance(learner, Adam):
            self.learner = AdamLearner(learner, self)
        elif isinstance(learner, CustomLearner):
            self.learner = NumpyLearner(self)
        else:
            ridge = getattr(policy, "regularization", getattr(learner, "regularization", 1.0))
            self.learner = LeastSquaresLearner(float(ridge), self)

    def tensor(self, values: Array) -> Tensor:
        """Return real numbers as a tensor where the trials are."""
        return torch.tensor(values, dtype=torch.float64, device=self.device)

    def _allocate(self) -> None:
        n, T, system = len(self.specs), self.system.horizon, self.system
        sizes = ((T + 1, system.n_states), (T, system.n_inputs), (T, system.n_learned))
        self.states, self.inputs, self.targets = (
            torch.full((n, *size), torch.nan, dtype=torch.float64, device=self.device)
            for size in sizes
        )
        self.sampled_states = torch.full_like(self.states[:, 1:], torch.nan)
        self.sampled_points = self.model.points(self.sampled_states)
        if not isinstance(system, BlackBox):  # which starts where its episodes do
            self.states[:, 0] = self.tensor(np.array(system.initial_state))
        self._rows = torch.tensor(system.learned_rows, device=self.device)
        self.diverged = torch.zeros(n, 1, dtype=torch.bool, device=self.device)

    def _hold_information(self) -> None:
        policy, q = self.config.policy, self.theta.shape[1]
        held = self.config.information
        self._sketch: Tensor | None = None
        self.information: BatchInformation | None = None
        if held is None or not isinstance(policy, InformationPolicy):
            return
        if held.form == "sketch" and isinstance(policy, DOptimal):
            buckets, signs = count_sketch(q, policy.sketch_size)
            self._sketch = torch.zeros(q, policy.sketch_size).to(self.theta)
            places = torch.tensor(buckets.astype(np.int64))
            self._sketch[torch.arange(q), places] = torch.tensor(signs).to(self.theta)
        self.information = self.information_kind(held.regularization, self.project(self.theta))

    def project(self, rows: Tensor) -> Tensor:
        """Return gradients, (..., q), in the space of M, (..., s): as they are, or their sketch."""
        return rows if self._sketch is None else rows @ self._sketch

    def observe(self, t: int, dt: float) -> None:
        """Store the accelerations observed from x_t to x_{t+1}, which came dt seconds later.

        With the integrator of Runge and Kutta, the accelerations follow
        :func:`dopt.kernel.loop.observe`.
        """
        system, x, u = self.system, self.states[:, t], self.inputs[:, t]
        at = x if system.integrator == "euler" else 0.5 * (x + self.states[:, t + 1])
        self.sampled_states[:, t] = at
        points = self.model.points(at.unsqueeze(1))
        self.sampled_points[:, t] = points.squeeze(1)
        known = known_flow(system, at, u)
        observed = ((self.states[:, t + 1] - x) / dt - known).index_select(1, self._rows)
        if system.integrator != "euler":
            end = model_states(system, self.model, self.theta, x, u, dt)
            step = ((end - x) / dt - known).index_select(1, self._rows)
            observed = observed - (step - self.model.at(self.theta, points).squeeze(1))
        self.targets[:, t] = observed

    def plan(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m); the first of a closed-loop policy is random."""
        policy, system, x = self.config.policy, self.system, self.states[:, t]
        if isinstance(policy, OpenLoop) or t == 0:
            return self.open_loop[:, t]
        if self.planners:
            return self._planned_in_numpy(t)
        if isinstance(policy, Uniform):
            seen = self.states[:, : t + 1]
            return uniform_inputs(system, self.model, self.theta, seen, policy.iterations)
        assert self.information is not None
        columns = planning_columns(system, self.model, self.theta, x, self.components[:, t])
        problem = quadratic_problem(self.project(columns), self.information)
        return d_optimal_inputs(problem, system.gamma, self.ties[:, t])

    def _planned_in_numpy(self, t: int) -> Tensor:
        """Return the inputs u_t, (n, m), of the trials' own plans; diverged ones get a random one.

        Raises
        ------
        SpecificationError
            If an input has the wrong shape or a norm above γ.
        """
        inputs = self.open_loop[:, t].clone()
        for i in self.alive():
            chosen = np.asarray(self.planners[i].choose(BatchTrialView(self, i, t)), np.float64)
            check_choice(self.config.policy.name, chosen, t, self.system)
            inputs[i] = torch.as_tensor(chosen).to(inputs)
        return inputs

    def learn(self, t: int) -> None:
        """Update the parameters with the samples up to step t; diverged trials keep theirs."""
        before = self.theta.clone()
        self.learner.learn(t)
        self.theta.copy_(torch.where(self.diverged, before, self.theta))

    def inform(self, t: int) -> None:
        """Add JᵀJ at x_t and the parameters after the learning step of time t (equation 5)."""
        for i in self.alive() if self.planners else ():
            self.planners[i].observe(BatchTrialView(self, i, t + 1))
        if self.information is not None:
            points = self.sampled_points[:, t : t + 1]
            J = jacobian(self.model, self.system.n_learned, self.theta, points)
            self.information.add(self.project(J[:, 0]))

    def alive(self) -> list[int]:
        """Return the places of the trials that have not diverged."""
        return [i for i, ended in enumerate(self.diverged[:, 0].tolist()) if not ended]


class BatchTrialView(TrialView):
    """Trial ``index`` of a batch after t steps, for a plan or an update in numpy."""

    def __init__(self, batch: BatchSteps, index: int, t: int) -> None:
        self.system, self.t = batch.system, t
        self._model, self._theta = batch.model, batch.theta[index].clone()
        self._batch, self._index = batch, index
        self.states = _array(batch.states[index, : t + 1])
        self.inputs = self.sampled_inputs = _array(batch.inputs[index, :t])
        self.sampled = _array(batch.sampled_states[index, :t])
        self.accelerations = _array(batch.targets[index, :t])
        self.parameters = _array(self._theta)
        last = t == self.system.horizon
        self.tie = np.full(self.system.n_inputs, np.nan) if last else _array(batch.ties[index, t])

    def points(self, states: Array, inputs: Array) -> Array:  # noqa: ARG002  # no model here reads inputs
        return np.asarray(states, dtype=np.float64)

    def predict(self, states: Array) -> Array:
        return _array(self._model(self._theta[None], self._tensor(states)[None])[0])

    def jacobian(self, state: Array) -> Array:
        at = self._model.points(self._tensor(state)[None, None])
        return _array(jacobian(self._model, self.system.n_learned, self._theta[None], at)[0, 0])

    def jacobian_change(self, state: Array, directions: Array) -> Array:
        along, r = self._tensor(directions), self.system.n_learned
        items = len(along) * r
        _, changes = gradients_and_changes(
            self._model,
            self._theta.expand(items, -1),
            self._tensor(state).expand(items, -1),
            torch.arange(r, device=along.device).repeat(len(along)),
            along.repeat_interleave(r, dim=0),
        )
        return _array(changes.view(len(along), r, -1))

    @property
    def covariance(self) -> Array:
        batch = self._batch
        assert batch.information is not None
        n, q = batch.theta.shape
        identity = torch.eye(q).to(batch.theta).repeat(n, 1, 1)
        return _array(batch.information.solve(identity)[self._index])

    def following(self, state: Array, inputs: Array) -> Array:
        u = self._tensor(inputs)
        x, theta = (one.expand(len(u), -1) for one in (self._tensor(state), self._theta))
        return _array(model_states(self.system, self._model, theta, x, u, self.system.dt))

    def input_matrix(self, state: Array) -> Array:
        return _array(input_matrix(self.system, self._tensor(state)[None])[0])

    def _tensor(self, values: Array) -> Tensor:
        contiguous = np.ascontiguousarray(values)  # torch takes no negative strides
        return torch.as_tensor(contiguous, dtype=self._theta.dtype, device=self._theta.device)


def _array(values: Tensor) -> Array:
    """Return a copy, so that nobody can change the trial."""
    return values.detach().cpu().numpy().copy()


class AdamLearner:
    """Adam on the newest samples, for the whole batch at once, as Adam is elementwise."""

    def __init__(self, learner: Adam, batch: BatchSteps) -> None:
        self._rule, self._batch = learner, batch
        self._moments = torch.zeros_like(batch.theta), torch.zeros_like(batch.theta)

    def learn(self, t: int) -> None:
        """Take one step on the samples up to step t: what torch.optim.Adam computes."""
        batch, rule = self._batch, self._rule
        newest = slice(max(0, t + 1 - rule.window), t + 1)
        gradient = loss_gradient(
            batch.model, batch.theta, batch.sampled_points[:, newest], batch.targets[:, newest]
        )
        first, second = self._moments
        first.lerp_(gradient, 1.0 - rule.beta_1)
        second.mul_(rule.beta_2).addcmul_(gradient, gradient, value=1.0 - rule.beta_2)
        unbiased = second.sqrt() / (1.0 - rule.beta_2 ** (t + 1)) ** 0.5
        rate = rule.learning_rate / (1.0 - rule.beta_1 ** (t + 1))
        batch.theta.addcdiv_(first, unbiased.add_(rule.epsilon), value=-rate)


def loss_gradient(model: BatchModel, theta: Tensor, points: Tensor, targets: Tensor) -> Tensor:
    """Return the gradient of mean_N ‖a_θ - y‖² by θ, (n, q), at points (n, N, ·), y (n, N, r)."""
    with torch.enable_grad():
        at, leaves = model.leaves(theta)
        values = model.at(at, points)
        slope = 2.0 / points.shape[1] * (values.detach() - targets)
        parts = torch.autograd.grad(values, leaves, slope, materialize_grads=True)
    return flat(parts).view_as(theta)


class LeastSquaresLearner:
    """Least squares over all samples with the ridge λ: θ = (λI + Σ JᵀJ)⁻¹ Σ Jᵀ(y - offset)."""

    def __init__(self, regularization: float, batch: BatchSteps) -> None:
        n, q = batch.theta.shape
        self._batch, self._moment = batch, torch.zeros_like(batch.theta)
        self._normal = regularization * torch.eye(q).to(batch.theta).repeat(n, 1, 1)

    def learn(self, t: int) -> None:
        """Absorb the sample of step t."""
        batch, points = self._batch, self._batch.sampled_points[:, t : t + 1]
        J = jacobian(batch.model, batch.system.n_learned, batch.theta, points)[:, 0]
        offset = batch.model.at(torch.zeros_like(batch.theta), points).squeeze(1)
        right = (batch.targets[:, t] - offset).unsqueeze(-1)
        self._normal = self._normal + J.mT @ J
        self._moment = self._moment + (J.mT @ right).squeeze(-1)
        batch.theta.copy_(torch.linalg.solve(self._normal, self._moment))


class NumpyLearner:
    """The updates of a learner that is written in numpy, one trial after the other."""

    def __init__(self, batch: BatchSteps) -> None:
        self._batch, updaters = batch, map(custom_updater, batch.specs)
        self._updaters = [updater for updater in updaters if updater is not None]

    def learn(self, t: int) -> None:
        """Write the parameters that the updates return after step t.

        Raises
        ------
        SpecificationError
            If there are not as many parameters as before.
        """
        batch = self._batch
        for i in batch.alive():
            updated = self._updaters[i].update(BatchTrialView(batch, i, t + 1))
            theta = np.asarray(updated, dtype=np.float64)
            check_update(batch.config.learner.name, theta, tuple(batch.theta[i].shape))
            batch.theta[i] = torch.as_tensor(theta).to(batch.theta)


class Lockstep(BatchSteps):
    """A batch of n trials of one configuration that take each step together.

    Parameters and errors as in :class:`BatchSteps`.
    """

    def __init__(self, specs: Sequence[TrialSpec], device: str = "cpu") -> None:
        super().__init__(specs, device)
        system = self.system
        self._episodes = []
        if isinstance(system, BlackBox):
            self._episodes = [system.episode(episode_seed(spec.seed)) for spec in self.specs]
            starts = np.stack([episode.state for episode in self._episodes])
            self.states[:, 0] = self.tensor(starts)
        self.columns = {name: np.full((len(specs), system.horizon), np.nan) for name in COLUMNS}
        points = evaluation_set(system)
        self._visited, self._applied = self.tensor(points.states), self.tensor(points.inputs)
        self._points = self.model.points(self._visited.unsqueeze(0))
        self._truth, self._n_grid = self.tensor(points.accelerations), points.n_grid
        self.checkpoints: dict[int, Array] = {}
        self.feedbacks: dict[int, list[Feedback | None]] = {}

    def act(self, t: int, u: Tensor) -> None:
        """Apply u_t, store x_{t+1} (equation 2) and the observed accelerations."""
        system, x = self.system, self.states[:, t]
        if self._episodes:
            u = self._step_episodes(t, u)
        else:
            following = next_states(
                system, x, u, lambda z: true_accelerations(system, z, u, t), system.dt
            )
            self.states[:, t + 1] = following + self.noise[:, t]
        self.inputs[:, t] = u
        self.observe(t, system.dt)

    def _step_episodes(self, t: int, u: Tensor) -> Tensor:
        """Advance the runs of a black box; return what was applied, (n, m).

        Where a run has restarted, the state before the step becomes its start.
        """
        applied = u.clone()
        for i, episode in enumerate(self._episodes):
            applied[i] = self.tensor(episode.step(u[i].cpu().numpy()))
            if (start := new_start(episode)) is not None:
                self.states[i, t] = self.tensor(start)
            self.states[i, t + 1] = self.tensor(episode.state)
        return applied

    def evaluate(self, t: int) -> tuple[Tensor, Tensor]:
        """Return the RMS errors at step t over the grid and over the reachable set, (n,) each."""
        if len(self.system.history) > 1:
            self._truth = true_accelerations(self.system, self._visited, self._applied, t)
        predicted = self.model.at(self.theta, self._points)
        squares = (predicted - self._truth).square().sum(dim=-1)
        grid, reachable = squares[:, : self._n_grid], squares[:, self._n_grid :]
        return grid.mean(dim=1).sqrt(), reachable.mean(dim=1).sqrt()

    def step(self, t: int) -> None:
        """Take step t of every trial and record it."""
        u, planned = self._timed(self.plan, t)
        self.act(t, u)
        inside = self.states[:, t + 1].abs() <= self.system.state_limit
        self.diverged |= ~inside.all(dim=1, keepdim=True)
        _, learned = self._timed(self.learn, t)
        _, informed = self._timed(self.inform, t)
        (loss, reachable), evaluated = self._timed(self.evaluate, t)
        self.diverged |= ~loss.isfinite().unsqueeze(1)
        losses = loss.cpu().numpy(), reachable.cpu().numpy()
        values = (*losses, planned + informed, learned, evaluated)
        for name, value in zip(COLUMNS, values, strict=True):
            self.columns[name][:, t] = value

    def _timed(self, function: Callable[..., Any], *given: Any) -> tuple[Any, float]:
        """Return what a function gives, and the time that it takes for each trial [µs]."""
        start, found = self._clock(), function(*given)
        return found, 1e6 * (self._clock() - start) / len(self.specs)

    def _clock(self) -> float:
        if self.device != "cpu":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()


class NetworkSteps(BatchSteps):
    """The steps of one trial of a custom network, with arrays in place of small tensors.

    They share the memory of the batch. An operation on a tensor of a few numbers costs several
    times that on an array.
    """

    information_kind = TrialInformation

    def __init__(self, specs: Sequence[TrialSpec], device: str = "cpu") -> None:
        super().__init__(specs, device)
        assert isinstance(self.model, NetworkFunction)
        self._network = self.model
        shared = (self.states, self.inputs, self.targets, self.sampled_states, self.sampled_points)
        self._x, self._u, self._y, self._at, self._phi = (tensor[0].numpy() for tensor in shared)
        self._scales, self._learned = self.system.feature_scales, list(self.system.learned_rows)

    def _features(self, x: Sequence[Scalar]) -> list[Any]:
        return feature_values(self.system.features, self._scales, x)

    def _point(self, x: Array) -> Tensor:
        return torch.from_numpy(np.array(self._features(tuple(x))))

    def _known(self, x: Array, u: Array) -> Array:
        known = self.system.known(tuple(x), tuple(u), self.system.parameters)
        return np.array(known, dtype=np.result_type(x, u))  # some may be whole numbers

    def _accelerations(self, x: Array) -> Array:
        return self._network.value(self.theta[0], self._point(x)).numpy()

    def _following(self, x: Array, u: Array, dt: float) -> Array:
        """Return the state, (d,), that the model predicts dt seconds after x under an input."""

        def rate(z: Array) -> Array:
            slope = self._known(z, u)
            slope[self._learned] += self._accelerations(z)
            return slope

        following: Array = next_state(self.system.integrator, rate, x, dt)
        return following

    def learn(self, t: int) -> None:
        """Update the parameters with the samples up to step t, unless the trial has diverged."""
        if not self.diverged.item():
            self.learner.learn(t)

    def observe(self, t: int, dt: float) -> None:
        """Store the accelerations observed in step t, as a batch does."""
        x, u, euler = self._x[t], self._u[t], self.system.integrator == "euler"
        at = x if euler else 0.5 * (x + self._x[t + 1])
        self._at[t], self._phi[t] = at, self._features(tuple(at))
        if euler:
            rest = (self._x[t + 1] - x) / dt - self._known(at, u)
            self._y[t] = rest[self._learned]
        else:
            rest = (self._x[t + 1] - self._following(x, u, dt)) / dt
            self._y[t] = rest[self._learned] + self._accelerations(at)

    def plan(self, t: int) -> Tensor:
        """Return the input u_t, (1, m), as a batch does."""
        system, policy, information = self.system, self.config.policy, self.information
        if t == 0 or self.planners or information is None or not isinstance(policy, DOptimal):
            return super().plan(t)
        columns = self.project(self._planning_columns(t))[None]
        (Q,), (v,) = (part.numpy() for part in quadratic_problem(columns, information))
        u = best_on_sphere(Q, v, self.ties[0, t].numpy(), system.gamma)
        return torch.from_numpy(u)[None]

    def _planning_columns(self, t: int) -> Tensor:
        """Return g and the columns of D B as rows, (1 + m, q)."""
        system, m = self.system, self.system.n_inputs
        bar = self._following(self._x[t], np.zeros(m), system.dt)
        B = np.array([self._known(bar, move).imag for move in 1j * STEP * np.eye(m)])
        moved = [self._features(tuple(bar + 1j * system.dt * b)) for b in B]
        along = torch.from_numpy(np.imag(moved) / STEP)
        component = int(self.components[0, t])
        return self._network.gradient_and_changes(self.theta[0], self._point(bar), component, along)


class NetworkTrial(NetworkSteps, Lockstep):
    """One trial of a custom network on this processor."""

    def act(self, t: int, u: Tensor) -> None:
        """Apply u_t, and store x_{t+1} (equation 2) and the observed accelerations."""
        if self._episodes:
            super().act(t, u)
            return
        system, x = self.system, self._x[t]
        self._u[t] = u[0].numpy()
        rate = functools.partial(system.derivative, inputs=self._u[t], step=t)
        following = next_state(system.integrator, rate, x, system.dt)
        self._x[t + 1] = following + self.noise[0, t].numpy()
        self.observe(t, system.dt)


@torch.no_grad()
def run_trials(
    specs: Sequence[TrialSpec], device: str = "cpu", noted: Sequence[int] | None = None
) -> list[TrialResult]:
    """Run trials of one configuration in lockstep; each result equals the trial's run alone.

    Parameters and errors as in :class:`BatchSteps`. The seconds and microseconds of a
    result are the batch's divided by its size. ``noted`` are the steps of its checkpoints, in place
    of those at which the trial is assessed.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    alone = len(specs) == 1 and device == "cpu" and isinstance(specs[0].model, Module)
    batch = (NetworkTrial if alone else Lockstep)(specs, device)
    noted = specs[0].assessed_steps if noted is None else noted
    for t in range(batch.system.horizon + 1):
        if t in noted:
            batch.checkpoints[t] = batch.theta.cpu().numpy().copy()
            batch.feedbacks[t] = [planner.feedback() for planner in batch.planners]
        if t < batch.system.horizon and not bool(batch.diverged.all()):
            batch.step(t)
    n = len(specs)
    seconds = ((time.perf_counter() - wall) / n, (time.process_time() - cpu) / n)
    return [_result(batch, i, *seconds) for i in range(n)]


def _result(batch: Lockstep, i: int, wall: float, cpu: float) -> TrialResult:
    """Cut trial i out of the batch; its rows end where it diverged."""
    states, inputs = batch.states[i].cpu().numpy(), batch.inputs[i].cpu().numpy()
    columns = {name: rows[i].copy() for name, rows in batch.columns.items()}
    inside = np.all(np.abs(states[1:]) <= batch.system.state_limit, axis=1)
    wrong = np.flatnonzero(~(inside & np.isfinite(columns["loss"])))
    end = int(wrong[0]) if len(wrong) else None
    if end is not None:
        for rows in (*columns.values(), inputs, states):
            rows[end:] = np.nan
    reached = [t for t in batch.checkpoints if end is None or t <= end]
    learned = {t: batch.feedbacks[t][i] for t in reached if batch.planners}
    return TrialResult(
        **columns,
        states=states,
        inputs=inputs,
        parameters=batch.theta[i].cpu().numpy().copy(),
        diverged_at=end,
        wall_seconds=wall,
        cpu_seconds=cpu,
        checkpoints={t: batch.checkpoints[t][i] for t in reached},
        feedbacks={t: feedback for t, feedback in learned.items() if feedback is not None},
    )


class ReferenceSteps:
    """The steps of a trial one by one: the caller says what state a plant has and what follows.

    The states and the inputs are theirs to write.
    """

    evidence: ClassVar[None] = None

    @torch.no_grad()
    def __init__(self, spec: TrialSpec) -> None:
        kind = NetworkSteps if isinstance(spec.model, Module) else BatchSteps
        self._spec, self._batch = spec, kind([spec])
        self.states: Array = self._batch.states[0].numpy()
        self.inputs: Array = self._batch.inputs[0].numpy()
        self.errors: Array = np.full(spec.system.horizon, np.nan)

    @property
    def parameters(self) -> Array:
        """Parameters of the model, (q,)."""
        return self._batch.theta[0].numpy().copy()

    @property
    def learned_inputs(self) -> Array:
        """Inputs beside the states that are learned from, (T, m): none is filtered here."""
        return self.inputs

    def begin(self, t: int, state: Array) -> None:
        """Begin step t at a state, (d,), whatever came before it."""
        self.states[t] = state

    def replace(self, parameters: Array, constants: Array) -> None:
        """Do nothing: no learner that replaces parameters runs here."""

    def measure(self, t: int, measured: Array) -> None:
        """Write what was measured after step t: x_{t+1}, (d,)."""
        self.states[t + 1] = measured

    def reached(self, t: int, inputs: Array, seconds: Array) -> Array:
        """Return the state, (d,), predicted from x_t after inputs (n, m) held for times (n,)."""
        x, system = self.states[t : t + 1], self._spec.system
        predict = functools.partial(self._spec.model.predict, system, self.parameters)
        for u, dt in zip(inputs, seconds, strict=True):
            rate = functools.partial(rates, system, predict, u[None])
            x = next_state(system.integrator, rate, x, float(dt))
        found: Array = x[0]
        return found

    def note_asked(self, u: Array) -> None:
        """Limits, which count rates from this input, are not enforced here."""

    @torch.no_grad()
    def plan_input(self, t: int) -> None:
        """Write the input u_t that the policy chooses at x_t."""
        self._batch.inputs[:, t] = self._batch.plan(t)

    @torch.no_grad()
    def take_in(self, t: int, dt: float) -> bool:
        """Learn from x_t, u_t and x_{t+1}, which came dt seconds later.

        Returns whether the parameters are finite.
        """
        batch = self._batch
        batch.observe(t, dt)
        predicted = batch.model.at(batch.theta, batch.sampled_points[:, t : t + 1])
        self.errors[t] = float(torch.linalg.vector_norm(batch.targets[0, t] - predicted[0, 0]))
        batch.learn(t)
        batch.inform(t)
        return bool(batch.theta.isfinite().all())
