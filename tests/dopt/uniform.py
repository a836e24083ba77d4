"""Samples at states drawn from the box of a system's grid, for tests of fits."""

from __future__ import annotations

import numpy as np

from dopt.evaluation import random_transitions
from dopt.offline_fit import Samples
from dopt.policies.base import ball_norms, on_sphere
from dopt.randomness import process_noise, stream
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox
from dopt.types import Array


def uniform_samples(spec: TrialSpec) -> Samples:
    """Return as many samples as a trial has steps, at states drawn uniformly from its grid's box.

    The noise is the trial's, w_t of equation 2. One step from a state x under any input is
    observed as y = a(x) + w/dt in the learned rows: the known part, and with it the input, cancels.
    Where the effect of the inputs is learned, they are drawn uniformly from the sphere ‖u‖ = γ, or
    from the ball within for a model that is not affine in them.
    State components without an axis in the grid are zero, as they are there. Of a system that
    changes, the accelerations belong to the last step, by which the final loss is judged.

    A black box that tells the truth at any state gives it, without noise. Other black boxes give
    transitions of runs under random inputs, made as for the loss but with other inputs; there may
    be fewer.
    """
    system, rng = spec.system, stream(spec.seed, "uniform_states")
    states, inputs = uniform_points(system, rng)
    if not spec.model.affine_in_inputs:
        inputs *= ball_norms(rng, (len(inputs), 1), system.n_inputs)
    if isinstance(system, BlackBox):
        truth = system.true_accelerations(states, inputs)
        if truth is not None:
            return Samples(states, inputs, truth)
        rng = stream(spec.seed, "uniform_states")
        return Samples(*random_transitions(system, system.horizon, rng))
    noise = process_noise(system, spec.seed)[:, list(system.learned_rows)] / system.dt
    accelerations = system.learned(states, system.horizon - 1, inputs)
    return Samples(states, inputs, accelerations + noise)


def uniform_points(system: System, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return as many states, (N, d), and inputs, (N, m), as a trial has steps."""
    states = np.zeros((system.horizon, system.n_states))
    for index, (low, high) in system.grid_box().items():
        states[:, index] = rng.uniform(low, high, system.horizon)
    draws = rng.standard_normal((system.horizon, system.n_inputs))
    return states, on_sphere(draws, system.gamma)
