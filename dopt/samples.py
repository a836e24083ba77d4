"""Samples to which a model can be fitted: drawn over the evaluation box, or recorded by a trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError
from dopt.evaluation import random_transitions
from dopt.policies.base import ball_norms, on_sphere
from dopt.randomness import process_noise, stream
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Samples:
    """States, inputs, and the accelerations that were observed there.

    Attributes
    ----------
    states : (N, d)
    inputs : (N, m)
        They count where the model reads inputs.
    accelerations : (N, r)
        Per second what the learned rows of the state are measured in, noise included.
    """

    states: Array
    inputs: Array
    accelerations: Array


def uniform_samples(spec: TrialSpec) -> Samples:
    """Return as many samples as a trial has steps, at states drawn uniformly from its grid's box.

    The noise is that of the trial, w_t of equation 2. One step from a state x under any input is
    observed as y = a(x) + w/dt in the learned rows: the known part, and with it the input, cancels.
    Where the effect of the inputs is learned, they are drawn uniformly from the sphere ‖u‖ = γ, or
    from the ball within for a model that is not affine in them.
    State components without an axis in the grid are zero, as they are there. Of a system that
    changes, the accelerations are those of the last step, by which the final loss is judged.

    Of a black box that tells the truth at any state, the samples are that, without noise. Of others
    they are transitions under random inputs, as those of its loss are, from runs of other inputs;
    there may be fewer.
    """
    system, rng = spec.system, stream(spec.seed, "uniform_states")
    states, inputs = _uniform_points(system, rng)
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


def _uniform_points(system: System, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return as many states, (N, d), and inputs, (N, m), as a trial has steps."""
    states = np.zeros((system.horizon, system.n_states))
    for index, (low, high) in system.grid_box().items():
        states[:, index] = rng.uniform(low, high, system.horizon)
    draws = rng.standard_normal((system.horizon, system.n_inputs))
    return states, on_sphere(draws, system.gamma)


def recorded_samples(system: System, states: Array, inputs: Array) -> Samples:
    """Return the samples of a trial, from its states (T + 1, d) and inputs (T, m).

    The observed accelerations are those that its learner was given: (x_{t+1} - x_t)/dt less the
    known part at x_t and u_t, in the learned rows. With the integrator of Runge and Kutta they are
    taken in the middle of the step, without what the learner's model adds to them. Where states are
    measured with noise they are those of the true states, which the learner was not given.

    Raises
    ------
    SpecificationError
        If the trial may have begun anew in its course: its record does not say where.
    """
    if getattr(system, "restarts", False):
        raise SpecificationError(
            f"env.restarts of {system.name} is true, but the samples of a trial in one piece are "
            f"expected, as its record does not say where it began anew: leave such trials out."
        )
    at = system.sampled_states(states)
    known = system.known(tuple(at.T), tuple(inputs.T), system.parameters)
    flow = np.stack(np.broadcast_arrays(*known, at[:, 0])[:-1], axis=-1)
    observed = np.diff(states, axis=0) / system.dt - flow
    return Samples(at, inputs, observed[:, list(system.learned_rows)])
