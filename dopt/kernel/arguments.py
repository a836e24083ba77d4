"""What the compiled functions are given: constants, mutable state and records, by name.

Legend of sizes: T steps, d states, m inputs, r learned accelerations, p features, q parameters,
w units in each hidden layer, L hidden layers, N evaluation points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

MLP_MODEL, LINEAR_MODEL = 0, 1
OPEN_LOOP, UNIFORM, D_OPTIMAL, SEARCH = 0, 1, 2, 3
ADAM, LEAST_SQUARES, REPLAY, KALMAN = 0, 1, 2, 3
PRIMAL, DUAL, SKETCH = 0, 1, 2
JOINT, SUM, TRACE, A_OPTIMAL, E_OPTIMAL, TASK = 0, 1, 2, 3, 4, 5


class World(NamedTuple):
    """The system's constants."""

    parameters: Floats  # physical parameters, at the start
    history: Floats  # (T, number of them) at each step; one row where they stay
    linear_form: Floats  # (1 + n_linear, number of physical parameters)
    learned_rows: Integers  # (r,)
    n_inputs: int  # m
    dt: float
    gamma: float
    state_limit: float


class Network(NamedTuple):
    """Architecture of the model."""

    kind: int  # MLP_MODEL or LINEAR_MODEL
    sizes: Integers  # (L + 2,) units of each layer, from p to r
    offsets: Integers  # (L + 1,) where each layer's weights start in the parameter vector
    feature_kinds: Integers  # (p,) 0 identity, 1 cos, 2 sin
    feature_indices: Integers  # (p,)
    feature_scales: Floats  # (p,)


class Search(NamedTuple):
    """Plans among which a policy searches (:mod:`dopt.policies.search`); none in others."""

    candidates: Floats  # (C, m)
    score: int  # JOINT, SUM, TRACE, A_OPTIMAL, E_OPTIMAL or TASK
    steps: int  # H
    switch: int  # steps after which the input may switch, H where it may not
    stride: int
    budget_us: float
    task_states: Floats  # (n, d)
    starts: Floats  # (b, q) of the Krylov space
    subspace: int


class Rules(NamedTuple):
    """Policy and learner."""

    policy: int  # OPEN_LOOP, UNIFORM, D_OPTIMAL or SEARCH
    all_components: bool  # whether D_OPTIMAL sums over the components
    search: Search
    ascent_steps: int  # of the uniform policy
    learner: int  # ADAM, LEAST_SQUARES, REPLAY or KALMAN
    learning_rate: float
    beta_1: float
    beta_2: float
    epsilon: float
    window: int  # newest samples that are kept
    batch: int  # samples in a step's loss: the window, or a minibatch
    steps: int  # minibatches at each time step
    noise_variance: float  # ρ of the Kalman filter
    forgetting: float  # f
    renewed: int  # diagonal entries of M that get back their share of the prior at each step
    renewal: float  # what is added to each
    informed: bool  # whether the policy plans with M
    form: int  # of the information matrix: PRIMAL, DUAL or SKETCH
    regularization: float  # λ of M₀ = λI


class Randomness(NamedTuple):
    """Numbers of :class:`dopt.randomness.Draws`."""

    noise: Floats  # (T, d)
    inputs: Floats  # (T, m)
    components: Integers  # (T,)
    ties: Floats  # (T, m)
    replay: Integers  # (T, steps, batch), empty without replay


class Evaluation(NamedTuple):
    """Points at which the model is compared with the truth, the grid's first.

    For the network they come in blocks of a fixed size, one point to a column, the last block of
    the grid and that of the reachable set padded; for the linear model one after the other.
    """

    single: npt.NDArray[np.float32]  # (blocks, p, block size), features in single precision
    features: Floats  # (blocks, p, block size)
    block_targets: Floats  # (blocks, r, block size)
    block_sizes: Integers  # (blocks,) points that count
    regressors: Floats  # (N, r, q) of the linear model
    targets: Floats  # (N, r) less the offset, of the linear model
    states: Floats  # (N, d) where the truth changes; otherwise empty
    n_grid: int  # blocks of the grid, or its points for the linear model
    n_all: int  # all blocks or points
    target_size: float  # root mean square of the targets


class Covariance(NamedTuple):
    """M⁻¹ = A - VᵀV (:mod:`dopt.kernel.information`); all empty where nothing needs it."""

    upper: Floats  # (q, q), A in the upper triangle
    pending: Floats  # (PENDING_ROWS, q), V in the first n_pending rows
    n_pending: Integers  # (1,)


class Dual(NamedTuple):
    """Rows of the Gram matrix and its factor (:mod:`dopt.kernel.dual`); empty in other forms."""

    features: Floats  # (T, p) at the states seen
    hidden: Floats  # (L, T, w)
    deltas: Floats  # (r, L, T, w)
    factor: Floats  # (r T, r T), C in the lower triangle
    n_states: Integers  # (1,)


class Sketch(NamedTuple):
    """Random projection of the parameters (:mod:`dopt.kernel.sketch`); empty in other forms."""

    buckets: Integers  # (q,)
    signs: Floats  # (q,)
    size: int


class Point(NamedTuple):
    """Passes of the network at one state for one component, and along m directions."""

    phi: Floats  # (p,)
    hidden: Floats  # (L, w)
    deltas: Floats  # (L, w)
    phi_dots: Floats  # (m, p)
    hidden_dots: Floats  # (m, L, w)
    deltas_dots: Floats  # (m, L, w)


class State(NamedTuple):
    """Everything that changes from step to step; written in place."""

    theta: Floats  # (q,) parameters
    moment_1: Floats  # (q,) of Adam
    moment_2: Floats  # (q,)
    covariance: Covariance
    dual: Dual
    sketch: Sketch
    window_features: Floats  # (p, window) newest samples, a ring
    window_targets: Floats  # (r, window)


class Record(NamedTuple):
    """What a trial leaves behind."""

    states: Floats  # (T + 1, d)
    inputs: Floats  # (T, m)
    loss: Floats  # (T,)
    reachable_loss: Floats  # (T,)
    plan_us: Floats  # (T,)
    learn_us: Floats  # (T,)
    evaluate_us: Floats  # (T,)
