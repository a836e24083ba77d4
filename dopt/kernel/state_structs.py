"""Structures that compiled functions write into from step to step, by name.

The legend of sizes is that of :mod:`dopt.kernel.structs`.
"""

from __future__ import annotations

from typing import NamedTuple

from dopt.types import Buckets, Integers, Matrix, Signs, Stack, Vector


class Covariance(NamedTuple):
    """M⁻¹ = A - VᵀV (:mod:`dopt.kernel.information`); all empty where nothing needs it."""

    upper: Matrix  # (q, q), A in the upper triangle
    pending: Matrix  # (PENDING_ROWS, q), V in the first n_pending rows
    n_pending: Integers  # (1,)


class Dual(NamedTuple):
    """Rows of the Gram matrix and its factor (:mod:`dopt.kernel.information.dual`).

    Empty in other forms.
    """

    features: Matrix  # (T, p) at the states seen
    hidden: Stack  # (L, T, w)
    deltas: Stack  # (r, L, T, w)
    factor: Matrix  # (r T, r T), C in the lower triangle
    n_states: Integers  # (1,)
    regularization: float  # λ of M₀ = λI


class Sketch(NamedTuple):
    """Random projection of the parameters (:mod:`dopt.kernel.information.sketch`).

    Empty in other forms.
    """

    buckets: Buckets  # (q,)
    signs: Signs  # (q,)
    size: int


class Visited(NamedTuple):
    """States visited, for fresh information (:mod:`dopt.kernel.information.fresh`).

    Empty where information is accumulated.
    """

    features: Matrix  # (p, T) at the states, of which n_states are filled
    n_states: Integers  # (1,)
    refresh_every: int  # steps
    regularization: float  # λ of M₀ = λI


class Posterior(NamedTuple):
    """Samples of a Gaussian process (:mod:`dopt.kernel.learners.conditioning`).

    Empty in other models.
    """

    factor: Matrix  # (T, T), L in the lower triangle
    solved: Matrix  # (T, r), z
    n_samples: Integers  # (1,)


class Linearization(NamedTuple):
    """Passes of the network at one state for one component, and along m directions."""

    phi: Vector  # (p,)
    hidden: Matrix  # (L, w)
    deltas: Matrix  # (L, w)
    phi_dots: Matrix  # (m, p)
    hidden_dots: Stack  # (m, L, w)
    deltas_dots: Stack  # (m, L, w)


class Members(NamedTuple):
    """Networks of an ensemble (:mod:`dopt.kernel.members`); empty in other models."""

    parameters: Matrix  # (E, q)
    priors: Matrix  # (E, q) before the first step


class PredictionError(NamedTuple):
    """Errors of the model and last input, kept for the limits; empty in trials without limits."""

    scale: Vector  # (r,) mean of e²/(1 + h) over the newest samples
    variances: Matrix  # (2, r), h = g M⁻¹ gᵀ at the present and at the predicted state
    last_input: Vector  # (m,) planned or applied


class Estimate(NamedTuple):
    """Outputs and filters that estimate states; all but the inputs empty where states are known."""

    starts: Matrix  # (T, d) states from which steps begin anew; NaN where they follow one another
    outputs: Matrix  # (T, n) measured after each step
    durations: Vector  # (T,) of the steps
    inputs: Matrix  # (T, m) that go with the accelerations: those applied, or these filtered
    filtered: Matrix  # (3, d) measured states and their differences, filtered, and as measured last
    filtered_input: Vector  # (m,)
    covariance: Matrix  # (d, d) of the state, given the parameters
    sensitivity: Matrix  # (d, q) of the estimated state to the parameters
    noise_variance: Vector  # (1,) ρ of the accelerations, which a fit may change


class State(NamedTuple):
    """Everything that changes from step to step; written in place."""

    theta: Vector  # (q,) parameters, of an ensemble those of its first member
    prior: Vector  # (q,) parameters before the first step
    members: Members
    moment_1: Vector  # (q,) of Adam
    moment_2: Vector  # (q,)
    covariance: Covariance
    factor: Matrix  # (q, q), the Cholesky factor of M of a learner that leaves it in place of M⁻¹
    dual: Dual
    sketch: Sketch
    visited: Visited
    posterior: Posterior
    prediction: PredictionError
    estimate: Estimate
    window_features: Matrix  # (p, window) newest samples, a ring
    window_targets: Matrix  # (r, window)
    policy_memory: Vector  # what a compiled policy of a user's own keeps
    learner_memory: Vector  # what a compiled learner of a user's own keeps


class Scratch(NamedTuple):
    """Memory that a learning step overwrites."""

    hidden: Matrix  # (L, room) flat activations of a batch
    deltas: Matrix  # (3, room) flat δ of a batch
    gradient: Vector  # (q,)


class Record(NamedTuple):
    """Results of a trial, step by step."""

    states: Matrix  # (T + 1, d) known, or estimated
    true_states: Matrix  # (T + 1, d) of a simulation; the same array where all are known
    inputs: Matrix  # (T, m)
    loss: Vector  # (T,)
    reachable_loss: Vector  # (T,)
    plan_us: Vector  # (T,)
    learn_us: Vector  # (T,)
    evaluate_us: Vector  # (T,)
