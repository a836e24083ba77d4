"""Estimate of the memory of a trial: its matrices, and its arrays over steps and points.

What else a trial holds is small beside these, or is stopped by the limit of its process
(``launch.memory_gib``). The interpreter and its libraries, some 0.2 GiB, come on top.

Legend of sizes: T steps, d states, m inputs, r learned accelerations, p features, q parameters,
w units in each hidden layer, N points of the evaluation grid.
"""

from __future__ import annotations

import math

from dopt.learning import GaussNewton, JointKalman, Learner
from dopt.models import MLP, RFF, GaussianProcess, Model
from dopt.policies import ICEM, DOptimal, Policy, Search
from dopt.spec.information_form import held_information, is_fresh
from dopt.systems import System

NUMBER = 8
"""Bytes of a double."""


def memory_by_setting(
    system: System, policy: Policy, model: Model, learner: Learner, path: str = "kernel"
) -> dict[str, int]:
    """Return the bytes that a trial holds at once, by the setting that decides about them.

    ``path`` is what runs it, "kernel" or "reference".
    """
    T, d, m, r = system.horizon, system.n_states, system.n_inputs, system.n_learned
    p, q = len(model.features(system)), model.n_member_parameters(system)
    columns = model.n_features if isinstance(model, RFF) else 2 * p
    kept = policy.memory_size(system, q) + learner.memory_size(system, q)
    numbers = {
        # states, noise, inputs as drawn and applied, ties, radii, five columns, components
        "env.horizon": T * (2 * d + 3 * m + 8),
        # states and their mesh, targets, and features in both precisions
        "env.grid_points": math.prod(system.grid_points) * (2 * d + 2 * r + columns),
        # parameters, two moments, gradient, and the copies for the evaluation
        _size_of(model): (4 + 2 * model.n_members) * q + kept,
    }
    for setting, count in _matrices(system, policy, model, learner, path).items():
        numbers[setting] = numbers.get(setting, 0) + count
    return {setting: NUMBER * count for setting, count in numbers.items()}


def _matrices(
    system: System, policy: Policy, model: Model, learner: Learner, path: str
) -> dict[str, int]:
    """Return the numbers of the information matrix, of JᵀJ, and of the rows J of both."""
    T, r, q = system.horizon, system.n_learned, model.n_member_parameters(system)
    held = held_information(policy, learner, q, r * T)
    form = held.form if held else "none"
    if isinstance(model, GaussianProcess):
        return {"env.horizon": 2 * T**2, "env.grid_points": 2 * T * math.prod(system.grid_points)}
    if form == "dual" and path == "kernel":
        return {"env.horizon": (r * T) ** 2}
    if form == "sketch" and isinstance(policy, DOptimal):
        rows = policy.sketch_size * (q if path == "reference" else 0)
        return {"policy.sketch_size": 3 * policy.sketch_size**2 + rows}
    rows = 2 * q**2 if form != "none" else 0
    if isinstance(policy, (Search, ICEM)):
        rows += q**2
    if isinstance(policy, Search):
        rows += 2 * policy.candidates * r * policy.steps(system) * q
    if isinstance(learner, JointKalman):
        rows += 4 * q**2 + T * system.n_measured * q
    return {_size_of(model): rows + _normal_matrix(system, policy, model, learner)}


def _normal_matrix(system: System, policy: Policy, model: Model, learner: Learner) -> int:
    """Return the numbers of JᵀJ and of the pairs of units of the samples over which it is summed.

    Where each sample is added by itself, there are none.
    """
    T, p, q = system.horizon, len(model.features(system)), model.n_member_parameters(system)
    kept = T if is_fresh(policy) and model.structure == "gradient" else 0
    if isinstance(learner, GaussNewton):
        kept = learner.samples_kept(T)
    w = model.width if isinstance(model, MLP) else 1
    return 4 * q**2 + 2 * kept * (p + (max(w, p) + 1) ** 2) if kept else 0


def _size_of(model: Model) -> str:
    """Return the setting that decides how many parameters a model has."""
    if isinstance(model, MLP):
        return "model.width"
    return "model.n_features" if isinstance(model, RFF) else "model"
