"""Estimate of the memory of a trial, from its sizes alone.

Legend of sizes: T steps, d states, m inputs, r learned accelerations, p features, q parameters,
w units in each of L hidden layers, N points of the evaluation grid.
"""

from __future__ import annotations

import math

from dopt.control import Control
from dopt.control.free_run import STARTS
from dopt.evaluation import run_steps
from dopt.learning import Adam, AdamReplay, GaussNewton, JointKalman, Learner
from dopt.models import MLP, RFF, GaussianProcess, Model
from dopt.policies import (
    ICEM,
    ActiveExploration,
    Disagreement,
    DOptimal,
    EOptimal,
    GradientDOptimal,
    Lookahead,
    Policy,
    Search,
    SoftActorCritic,
    TaskOptimal,
)
from dopt.policies.active_exploration import AGENT_UNITS
from dopt.policies.icem import BLOCKS
from dopt.spec.information_form import held_information, is_fresh
from dopt.systems import System

NUMBER = 8
"""Bytes of a double."""

OTHER_POINTS = 768
"""Evaluation points beside the grid: 512 of the reachable set, and at most 256 of padding."""

STRONG_INPUTS = 8
"""Simulated sequences from which the reachable set is drawn (:mod:`dopt.evaluation`)."""


def memory_by_setting(
    system: System,
    policy: Policy,
    model: Model,
    learner: Learner,
    path: str = "kernel",
    task: Control | None = None,
) -> dict[str, int]:
    """Return the bytes that a trial holds at once, by the setting that decides about them.

    ``path`` is what runs it, "kernel" or "reference". A ``task`` has every field set. The
    interpreter and its libraries, some 0.2 GiB, come on top.
    """
    T, d, m, r = system.horizon, system.n_states, system.n_inputs, system.n_learned
    steps = run_steps(system)
    p, q = len(model.features(system)), model.n_member_parameters(system)
    N = math.prod(system.grid_points)
    w, L = (model.width, model.depth) if isinstance(model, MLP) else (1, 1)
    window = learner.window if isinstance(learner, Adam) else 0
    changing = T * len(system.physical) + N * (d + r) if len(system.history) > 1 else 0
    numbers = {
        # states, noise, inputs as drawn and applied, ties, radii, five columns, components; strong
        # inputs
        "env.horizon": T * (2 * d + 3 * m + 8) + changing + STRONG_INPUTS * steps * (d + m),
        # states and their mesh, targets, and features in both precisions
        "env.grid_points": N * (2 * d + 2 * r + 2 * p),
        # parameters, two moments, gradient, and the copies for the evaluation
        _size_of(model): (4 + 2 * model.n_members) * q,
        "learner.window": window * (p + r + (L + 3) * max(w, r)),
    }
    if isinstance(learner, AdamReplay):
        # the samples kept, the places drawn, and the passes of the network over a minibatch
        numbers["env.horizon"] += min(learner.capacity, T) * (p + r)
        drawn = T * learner.steps * learner.batch
        numbers["learner.batch"] = drawn + learner.batch * (p + r + (L + 3) * max(w, r))
    if kept := _samples_of_normal_matrix(policy, model, learner, T):
        # the samples kept, the pairs of units of one block, and JᵀJ, its factor and C⁻¹ in blocks
        numbers["env.horizon"] += 2 * kept * (p + r)
        pairs = kept * (2 * (max(w, p) + 1) ** 2 + (r + 3) * (L + 1) * (max(w, p) + 1))
        rows = 3 * kept * r * q if path == "reference" else 0  # J itself, and copies of it
        numbers[_size_of(model)] += pairs + rows + 4 * q**2
    if isinstance(learner, JointKalman):
        # true states, outputs, the rows and errors of all innovations, JᵀJ and its factor, and Ψ
        n = system.n_measured
        numbers["env.horizon"] += T * (2 * d + 3 * n)
        rows = T * n * q * (2 if path == "reference" else 1)
        numbers[_size_of(model)] += rows + 4 * q**2 + 3 * d * q
    kept = policy.memory_size(system, q) + learner.memory_size(system, q)
    numbers[_size_of(model)] += kept
    held = held_information(policy, learner, q, r * T)
    form = held.form if held else "none"
    if path == "kernel":
        information = _information(policy, form, model, q, r * T, T * (p + L * w * (1 + r)))
    else:
        information = _information_of_reference(policy, form, model, q)
    if isinstance(model, RFF) and path == "kernel":
        # the features at the evaluation points
        numbers[_size_of(model)] += model.n_features * (N + OTHER_POINTS)
    parts = (information, _search(policy, system, model, path), _beyond(policy, system, model))
    for part in (*parts, _task(task, system, q) if task else {}):
        for setting, count in part.items():
            numbers[setting] = numbers.get(setting, 0) + count
    return {setting: NUMBER * count for setting, count in numbers.items()}


def _samples_of_normal_matrix(policy: Policy, model: Model, learner: Learner, horizon: int) -> int:
    """Return over how many samples JᵀJ is summed at once; 0 where each one is added by itself."""
    if isinstance(learner, GaussNewton):
        return learner.samples_kept(horizon)
    return horizon if is_fresh(policy) and model.structure == "gradient" else 0


def _size_of(model: Model) -> str:
    """Return the setting that decides how many parameters a model has."""
    if isinstance(model, MLP):
        return "model.width"
    return "model.n_features" if isinstance(model, RFF) else "model"


def _information(
    policy: Policy, form: str, model: Model, q: int, n_rows: int, n_factors: int
) -> dict[str, int]:
    """Return the numbers of the information matrix, in the form in which it is held.

    The inverse is made from an identity matrix, which makes two of them for a moment.
    """
    if form == "none":
        return {}
    if form == "primal":
        return {_size_of(model): 2 * q**2 + 16 * q}
    if form == "dual":
        return {"env.horizon": n_rows**2 + n_factors}
    size = policy.sketch_size if isinstance(policy, DOptimal) else 0
    return {"policy.sketch_size": 2 * size**2, "model.width": 2 * q}


def _information_of_reference(policy: Policy, form: str, model: Model, q: int) -> dict[str, int]:
    """Return the numbers of M, its factor and its update, which the reference holds as they are.

    It has no dual form, and its sketch is a matrix.
    """
    if form == "none":
        return {}
    setting = _size_of(model)
    if isinstance(policy, DOptimal) and form == "sketch":
        size = policy.sketch_size
        return {"policy.sketch_size": 3 * size**2, setting: q * size}
    return {setting: 3 * q**2}


def _search(policy: Policy, system: System, model: Model, path: str) -> dict[str, int]:
    """Return the numbers of a search: M⁻¹ in full, the rows of a path, all scores.

    The kernel holds the rows of the plans that begin with the same input, the reference all.
    """
    q, r = model.n_member_parameters(system), system.n_learned * _points_of_state(system, model)
    if isinstance(policy, ICEM):
        return _sampling(policy, system, q, r)
    if not isinstance(policy, Search):
        return {}
    steps = policy.steps(system)
    rows = r * (steps // policy.stride_of(system) if isinstance(policy, Lookahead) else steps)
    count = policy.count if isinstance(policy, TaskOptimal) else 0
    subspace = min(q, policy.subspace) if isinstance(policy, EOptimal) else 0
    return {
        _size_of(model): q**2 + r * q,
        "policy.lookahead": 2 * rows * q + rows**2 + steps * (system.n_states + r),
        "policy.candidates": policy.candidates**2 * (1 if path == "kernel" else 2 * rows * q)
        + (_paths_of_kernel(policy, system, model, rows) if path == "kernel" else 0),
        "policy.count": count * (r * q + system.n_states),
        "policy.subspace": subspace * (2 * q + 2 * subspace) + (r + 1) * q,
    }


def _paths_of_kernel(policy: Search, system: System, model: Model, rows: int) -> int:
    """Return the numbers of paths that advance together, and of the rows along C of them.

    There are C² paths, or C where no input switches, and at most so many ``rows`` along each.
    """
    C, d, m, r = policy.candidates, system.n_states, system.n_inputs, system.n_learned
    q, hidden = model.n_member_parameters(system), len(model.features(system)) + r
    if isinstance(model, MLP):
        hidden += model.width * model.depth
    one = 3 * d + 2 * m + hidden + rows // r * (d + m)
    return (C**2 if policy.steps(system) > 1 else C) * one + 2 * C * rows * q


def _points_of_state(system: System, model: Model) -> int:
    """Return how many points stand for a state of a path (:mod:`dopt.kernel.points`)."""
    return max(1, 2 * model.n_inputs_read(system))


def _sampling(policy: ICEM, system: System, q: int, r: int) -> dict[str, int]:
    """Return the numbers of the sampling planner: its plans, their paths and the rows along them.

    There are r rows for each state. The factor of M⁻¹ and the draws of the parameters belong to the
    model.
    """
    d, m, count = system.n_states, system.n_inputs, policy.task_count
    plans, states = policy.plans + policy.elites, policy.lookahead // policy.stride
    drawn, directions = BLOCKS * policy.iterations * policy.plans, policy.samples + r * count
    return {
        "policy.plans": plans * (states * (d + r * directions) + 2 * policy.segments * m),
        "policy.lookahead": drawn * policy.segments * m,
        "policy.samples": q * (policy.samples + 3 * directions),
        "model.width": q**2,
    }


def _beyond(policy: Policy, system: System, model: Model) -> dict[str, int]:
    """Return the numbers of an ensemble, of a covariance and of a Gaussian process, by setting."""
    T, r, q = system.horizon, system.n_learned, model.n_member_parameters(system)
    N = math.prod(system.grid_points)
    if isinstance(policy, Disagreement):
        per_network = 6 * q + T * (system.n_states + r)
        units = model.depth * model.width if isinstance(model, MLP) else q
        return {
            "policy.ensemble": policy.ensemble * per_network,
            "policy.candidates": policy.candidates * policy.ensemble * (r + units),
        }
    if isinstance(policy, (SoftActorCritic, ActiveExploration)):
        return _agent(policy, system)
    if isinstance(policy, GradientDOptimal):
        return {"policy.candidates": policy.candidates * 2 * r * q, _size_of(model): q**2}
    if isinstance(model, GaussianProcess):
        # the factor, and the kernel between all samples and all evaluation points
        return {"env.horizon": 2 * T**2 + OTHER_POINTS * T, "env.grid_points": 2 * N * T}
    return {}


def _agent(policy: SoftActorCritic | ActiveExploration, system: System) -> dict[str, int]:
    """Return the numbers of an agent: five networks in training, a minibatch, the transitions.

    For MAX also those of the ensemble in training, and what it says of each run.
    """
    d, batch = system.n_states, policy.batch
    observed = 2 * d + system.n_inputs
    if isinstance(policy, SoftActorCritic):
        networks = policy.units * (20 * (policy.units + observed) + 12 * batch)
        kept = {"env.horizon": (system.horizon // policy.hold + 1) * 2 * observed}
        return {"policy.units": networks, **kept}
    networks = AGENT_UNITS * (20 * (AGENT_UNITS + observed) + 12 * batch)
    decisions = -(-policy.lookahead // policy.hold)
    each = 4 * policy.ensemble * policy.units + decisions * policy.episodes * 2 * observed
    return {
        "policy.batch": networks + 4 * policy.ensemble * policy.units * batch,
        "policy.units": 6 * policy.ensemble * policy.units**2,
        "policy.ensemble": 4 * policy.ensemble**2 * policy.actors * system.n_learned,
        "policy.actors": policy.actors * each,
    }


def _task(task: Control, system: System, q: int) -> dict[str, int]:
    """Return the numbers of an assessment: its planner, episode, free run and checkpoints."""
    goal, d, m = task.on(system), system.n_states, system.n_inputs
    # a planned step of each sample: state, error, square, two costs, input in two orders
    sizes = {"task.samples": task.samples, "task.hold": goal.hold, "task.lookahead": goal.lookahead}
    planned = (
        math.prod(sizes.values()) * (3 * d + 2 * m + 2) + task.samples * goal.lookahead * 4 * m
    )
    return {
        max(sizes, key=lambda key: sizes[key]): planned,
        "task.steps": goal.steps * (4 * d + m),
        # the true states and the predicted ones, two squares, and the inputs in three orders
        "task.free_run_steps": STARTS * task.free_run_steps * (5 * d + 3 * m),
        "task.checkpoints": len(task.assessed_steps(system.horizon)) * q,
    }
