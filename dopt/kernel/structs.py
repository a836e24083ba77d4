"""Structures of a trial in compiled code: first what its steps write, then what they read.

Sizes: T steps, d states, m inputs, r learned accelerations, p features, q parameters, w units in
each hidden layer, L hidden layers, N evaluation points, D random features. A point is what a model
depends on: a state, (d,), or a state and an input, (d + m,) (:mod:`dopt.kernel.model`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from dopt.types import (
    Accelerations,
    Buckets,
    ComplexAccelerations,
    Integers,
    Known,
    Matrix,
    Signs,
    Singles,
    Stack,
    Vector,
)


class Covariance(NamedTuple):
    """M⁻¹ = A - VᵀV (:mod:`dopt.kernel.information`); all empty where nothing needs it."""

    upper: Matrix  # (Q, Q), A in the blocks on and above the diagonal; Q is q padded with zeros
    pending: Matrix  # (·, Q), V in the first n_pending rows
    rows: Matrix  # (·, Q), the deferred ones, then those that a plan multiplies
    products: Matrix  # (·, Q), M⁻¹ times the rows
    n_pending: Integers  # (1,)
    n_deferred: Integers  # (1,)
    size: int  # q


class Dual(NamedTuple):
    """Rows of the Gram matrix and its factor (:mod:`dopt.kernel.information`).

    Empty in other forms.
    """

    features: Matrix  # (T, p) at the states seen
    hidden: Stack  # (L, T, w)
    deltas: Stack  # (r, L, T, w)
    factor: Matrix  # (r T, r T), C in the lower triangle
    n_states: Integers  # (1,)
    regularization: float  # λ of M₀ = λI


class Sketch(NamedTuple):
    """Random projection of the parameters (:mod:`dopt.kernel.information`).

    Empty in other forms.
    """

    buckets: Buckets  # (q,)
    signs: Signs  # (q,)
    size: int


class Visited(NamedTuple):
    """States visited, for fresh information (:mod:`dopt.kernel.information`).

    Empty where information is accumulated.
    """

    features: Matrix  # (p, T) at the states, of which n_states are filled
    n_states: Integers  # (1,)
    refresh_every: int  # steps
    regularization: float  # λ of M₀ = λI


class Posterior(NamedTuple):
    """Samples of Gaussian processes (:mod:`dopt.kernel.gaussian_process`), with room for C.

    Empty in other models.
    """

    factors: Stack  # (2G, C, C), L of each kernel in the lower triangle, and room for others
    targets: Matrix  # (r, C)
    solved: Matrix  # (r, C), z
    counts: Vector  # (C,) observations of which each sample is the mean
    first: Integers  # (1,) 0 or G, where the G factors in force begin
    newest_state: Vector  # (d,) where the newest sample was taken
    newest_target: Vector  # (r,)


class Linearization(NamedTuple):
    """Passes of the network at one state for one component, and along m directions."""

    phi: Vector  # (p,)
    hidden: Matrix  # (L, w)
    deltas: Matrix  # (L, w)
    phi_dots: Matrix  # (m, p)
    hidden_dots: Stack  # (m, L, w)
    deltas_dots: Stack  # (m, L, w)


class Members(NamedTuple):
    """Networks of an ensemble (:mod:`dopt.kernel.loop`); empty in other models."""

    parameters: Matrix  # (E, q)
    priors: Matrix  # (E, q) before the first step


class PredictionError(NamedTuple):
    """Errors of the model and last input, kept for the limits; empty in trials without limits."""

    scale: Vector  # (r,) mean of e²/(1 + h) over the newest samples
    variances: Matrix  # (2, r), h = g M⁻¹ gᵀ at the present and at the predicted state
    last_input: Vector  # (m,) planned or applied


class Estimate(NamedTuple):
    """Outputs and filters that estimate states; all but the inputs empty where states are known."""

    starts: Matrix  # (T, d) states from which steps restart; NaN where they follow one another
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

    theta: Vector  # (q,) parameters; of an ensemble: of its first member
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
    policy_memory: Vector  # memory of a compiled policy in a user's file
    learner_memory: Vector  # memory of a compiled learner in a user's file


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


class Plant(NamedTuple):
    """The system: its compiled equations, each writing into its last argument, and constants."""

    known: Known  # (x, u, p, out), known part of dx/dt
    accelerations: Accelerations  # (x, p, out), learned accelerations; x, or (x, u) where read
    complex_accelerations: ComplexAccelerations  # (x, p, out), the same for complex arguments
    parameters: Vector  # physical parameters, at the start
    history: Matrix  # (T, number of them) at each step; one row where they stay
    linear_form: Matrix  # (1 + n_linear, number of physical parameters)
    learned_rows: Integers  # (r,)
    n_inputs: int  # m
    n_inputs_read: int  # m where the learned accelerations depend on the inputs, 0 elsewhere
    dt: float
    gamma: float
    state_limit: float
    integrator: int  # dopt.algorithm.Integrator
    n_carried: int  # last states, which are inputs in flight and actuators
    lead: int  # steps after which an input begins to act
    cut_at: float  # magnitude to which an input is cut


class Waves(NamedTuple):
    """Random features (:mod:`dopt.kernel.model`); empty in other models."""

    frequencies: Matrix  # (D, p), Ω
    phases: Vector  # (D,), b
    scale: float  # s √(2/D)


class Process(NamedTuple):
    """Gaussian processes (:mod:`dopt.kernel.gaussian_process`); empty in other models."""

    shared: Matrix  # (1, 2p + 3), numbers of the kernel of all rows; (0, ·) where θ holds them
    room: int  # C
    selects_from: int  # samples from which on one that adds little is merged; C where all have room
    n_samples: Integers  # (1,)


class Network(NamedTuple):
    """Architecture of the model."""

    kind: int  # dopt.algorithm.ModelKind
    sizes: Integers  # (L + 2,) units of each layer, from p to r
    layer_inputs: Integers  # (L + 1,) columns of each layer's weights
    offsets: Integers  # (L + 1,) where each layer's weights start in the parameter vector
    n_inputs_read: int  # m where the model depends on the inputs, 0 elsewhere
    n_factors: int  # m where they multiply the last hidden layer, 0 elsewhere
    unknown: Integers  # (q,) which constants of the plant are θ; empty but in a grey box
    feature_kinds: Integers  # (p,) dopt.algorithm.FeatureKind
    feature_indices: Integers  # (p,)
    feature_scales: Vector  # (p,)
    waves: Waves
    process: Process


class Search(NamedTuple):
    """Plans among which a policy chooses (:mod:`dopt.policies.search`); none in others."""

    candidates: Matrix  # (C, m)
    task_states: Matrix  # (n, d)
    domain: Matrix  # (2, d), half-widths of the box in which rows count, and periods (0: none)
    starts: Matrix  # (b, q) of the Krylov space
    row_scale: float  # 1/√ρ, by which the rows of a path are multiplied: a sample adds JᵀJ/ρ to M
    score: int = 0  # dopt.algorithm.Score
    steps: int = 0  # H
    switch: int = 0  # steps after which the input may switch, 0 where it may not
    stride: int = 1
    budget_us: float = 0.0
    subspace: int = 0
    hold: int = 1  # steps for which an input of a sampled plan is held
    plans: int = 0  # sampled in an iteration
    iterations: int = 0
    elites: int = 0
    task_count: int = 0  # task states of a step
    replan_every: int = 1  # steps from one search to the next


class Algorithm(NamedTuple):
    """Settings of policy and learner."""

    policy: Vector  # numbers of the policy, in the order that its kernel function takes
    learner: Vector  # numbers of the learner, in the order that its kernel function takes
    search: Search


class Limits(NamedTuple):
    """Bounds of states and inputs, infinite where unbounded (:mod:`dopt.kernel.limits`)."""

    enforced: bool
    lower: Vector  # (d,)
    upper: Vector  # (d,)
    input_lower: Vector  # (m,)
    input_upper: Vector  # (m,)
    input_change: Vector  # (m,) largest from one step to the next
    steps: int  # H of a predicted path, 0 where no state is bounded
    margin: float  # of the error of a prediction, in its standard deviations


class Sensors(NamedTuple):
    """Outputs y = C x + v (:mod:`dopt.kernel.sensors`); empty where all states are known."""

    output_matrix: Matrix  # C, (n, d)
    measured: Integers  # (n,) indices of the measured states; empty where outputs mix states
    variances: Vector  # (n,) of their noise
    quanta: Vector  # (n,) steps to which outputs are rounded, 0 where they have noise
    positions: Integers  # (d,) whose difference estimates a state; itself where it is measured
    factors: Vector  # (d,) the rate of that state in units of the estimated one, 1 where measured
    cutoff: float  # of the low-pass filter, in Hz; 0 where a learner estimates
    delay: float  # steps by which differences come late
    start_variances: Vector  # (d,) of a state from which an exploration goes on


class Randomness(NamedTuple):
    """Numbers of :class:`dopt.randomness.Draws`."""

    noise: Matrix  # (T, d)
    measurement_noise: Matrix  # (T, n) of the measured states
    inputs: Matrix  # (T, m)
    components: Integers  # (T,)
    ties: Matrix  # (T, m)
    radii: Matrix  # (T, 2) norms in γ of the planned input and of the next one in its criterion
    replay: Integers  # (T, steps, batch), empty without replay
    plans: Matrix  # (blocks, numbers) of the sampling planner
    parameters: Matrix  # (q, s) of its draws of the parameters; both empty in other policies


class Evaluation(NamedTuple):
    """Points at which the model is compared with the truth, the grid's first.

    They come in blocks of a fixed size, one point to a column, the last block of the grid and that
    of the reachable set padded; for the linear model one after the other.
    """

    single: Singles  # (blocks, p, block size), features in single precision
    features: Stack  # (blocks, p, block size)
    basis: Stack  # (blocks, D or T, block size), random features, or the kernel with the samples
    n_basis: Integers  # (1,) rows of a block of ``basis`` that are filled
    block_targets: Stack  # (blocks, r, block size)
    block_sizes: Integers  # (blocks,) points that count
    regressors: Stack  # (N, r, q) of the linear model
    targets: Matrix  # (N, r) less the offset, of the linear model
    states: Matrix  # (N, d) where the truth changes, or (N, d + m); otherwise empty
    bounds: Integers  # (3,) blocks, or points for the linear model: 0, the grid's, all
    target_size: float  # root mean square of the targets


AddRows = Callable[[Plant, Network, State, Vector], None]
"""Addition of JᵀJ to M at a point and the current parameters."""

PlanningForms = Callable[[Plant, Network, State, Vector, Matrix, int], Matrix]
"""Products xᵀM⁻¹y for x and y among g and the columns of D B, (1 or 1 + m, 1 + m).

Given a point, the columns of B as rows, (m, d), with zeros behind them for inputs that the model
reads, and the component of a_θ whose gradient g is.
With one input the row of g is enough: the quadratic term of equation 7 is constant on the sphere.
"""


class Information(NamedTuple):
    """Compiled functions for the form that holds M (:mod:`dopt.kernel.information`)."""

    add_rows: AddRows
    planning_forms: PlanningForms


class Trial(NamedTuple):
    """Arguments of the policy and the learner of a trial.

    At step t a policy finds the states x_0 ... x_t, or their estimates, in
    ``record.states[: t + 1]`` and the inputs u_0 ... u_{t-1} in ``record.inputs[:t]``.
    """

    plant: Plant
    network: Network
    algorithm: Algorithm
    information: Information
    limits: Limits
    sensors: Sensors
    randomness: Randomness
    state: State
    scratch: Scratch
    record: Record


Plan = Callable[[Trial, int, Vector], None]
"""Choice of the input: trial, step t and the input u_t, (m,), which it writes."""

Learn = Callable[[Trial, int, Vector], None]
"""Learning step: trial, step t and the accelerations observed in it, (r,)."""

EstimateState = Callable[[Trial, int, float], None]
"""Estimate of x_{t+1}: trial, step t and its duration."""

Observe = Callable[[Trial, int, float, Vector], None]
"""Observation: trial, step t, its duration and the accelerations in it, (r,), which it writes."""


class Steps(NamedTuple):
    """Compiled functions that the steps of a trial call, by what the trial consists of."""

    plan: Plan
    learn: Learn
    limit_input: Plan  # replaces the input
    note_error: Learn  # before the accelerations are learned
    estimate_state: EstimateState
    observe: Observe
