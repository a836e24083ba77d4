"""Sampling planners in compiled code (:mod:`dopt.policies.search`): at each step, or in episodes.

Sizes beside :mod:`dopt.kernel.structs`: H steps of a plan, K inputs of it, P plans, n states of its
path whose rows count, g + s directions.

Accelerations at many states are predicted along draws of the parameters, which have the covariance
M⁻¹ = U Uᵀ with U upper triangular, the inverse of the transposed Cholesky factor of M. For a
matrix Z, (q, s), of standard normal numbers divided by √s, W = U Z has E[(J W)(J W)ᵀ] = J M⁻¹ Jᵀ:
the covariance of accelerations from s numbers for each row of J. For the rows of a matrix G the
products with any other row are made exact: Z = [Q, (I - Q Qᵀ) Ω / √s] with an orthonormal basis Q
of the rows of G U.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import TIE_MARGIN, ModelKind, Score
from dopt.kernel import gaussian_process as gp
from dopt.kernel import network as nn
from dopt.kernel.compiler import compiled, squared
from dopt.kernel.linear_algebra import (
    factorize,
    solve_columns,
    solve_transposed_columns,
    write_dense,
)
from dopt.kernel.model import n_next_points, parameter_rows
from dopt.kernel.network import batch_back_signals, multiply_vector, output_inputs
from dopt.kernel.search import roll, rows_at_states
from dopt.kernel.structs import Network, Plant, State, Trial
from dopt.kernel.vectors import (
    add_multiple,
    inner,
    multiply,
    multiply_and_shift,
    product,
    subtract_product,
)
from dopt.types import Matrix, Stack, Vector

DOMAIN_MARGIN = 0.25
"""Half-widths beyond the box at which a row of a state counts e^(-1/2) times."""

SPREAD_KEPT = 0.1
"""Share of the mean and the spread of one iteration of the cross-entropy method in the next."""


class Directions(NamedTuple):
    """Directions W of the parameters along which the model is differentiated."""

    rows: Matrix  # Wᵀ, (g + s, q), the g exact ones first
    exact: Matrix  # R with Gᵀ = U⁻ᵀ Q R, (g, rows of G)


class Root(NamedTuple):
    """A root of M⁻¹ = U Uᵀ by a Cholesky factor, (q, q).

    The factor of M, whose inverse is Uᵀ, or the factor of M⁻¹ with rows and columns in reverse
    order, which is U in reverse order.
    """

    factor: Matrix
    of_inverse: bool


@compiled
def directions(state: State, normals: Matrix, chosen: Matrix) -> tuple[bool, Directions]:
    """Return W for standard normal numbers Ω, (q, s), and the rows of G, (·, q).

    False is returned where rounding has left M⁻¹ indefinite.
    """
    q, s = normals.shape
    g = min(q, chosen.shape[0])
    found = Directions(np.empty((g + s, q)), np.empty((g, chosen.shape[0])))
    root = Root(state.factor, state.factor.shape[0] == 0)
    if root.of_inverse:
        root = Root(np.empty((q, q)), True)
        write_dense(state.covariance, root.factor)
        root.factor[:] = root.factor[::-1, ::-1].copy()
        if not factorize(root.factor):
            return False, found
    Z, random = np.empty((q, g + s)), normals / np.sqrt(s)
    if g > 0:
        Q, R = np.linalg.qr(_transposed_products(root, chosen.T.copy()))
        basis = Q.copy()
        subtract_product(basis, product(basis.T, random), random)
        Z[:, :g] = basis
        found.exact[:] = R
    Z[:, g:] = random
    found.rows[:] = _products(root, Z).T
    return True, found


@compiled
def _transposed_products(root: Root, columns: Matrix) -> Matrix:
    """Return Uᵀ times columns, (q, k)."""
    if root.of_inverse:
        return product(root.factor.T, columns[::-1].copy())[::-1].copy()
    solve_columns(root.factor, columns)
    return columns


@compiled
def _products(root: Root, columns: Matrix) -> Matrix:
    """Return U times columns, (q, k)."""
    if root.of_inverse:
        return product(root.factor, columns[::-1].copy())[::-1].copy()
    solve_transposed_columns(root.factor, columns)
    return columns


@compiled
def changes_along(
    plant: Plant, network: Network, theta: Vector, states: Matrix, along: Matrix, out: Stack
) -> None:
    """Write J W, (r, s, N), at points, (N, ·), for directions Wᵀ, (s, q)."""
    N, r = states.shape[0], out.shape[0]
    if network.kind != ModelKind.MLP:
        rows, value = np.empty((r, theta.shape[0])), np.empty(r)
        change = np.empty(along.shape[0])
        for n in range(N):
            parameter_rows(plant, network, theta, states[n], rows, value)
            for k in range(r):
                multiply_vector(along, rows[k], change)
                out[k, :, n] = change
        return
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    features, outputs = np.empty((network.feature_kinds.shape[0], N)), np.empty((r, N))
    hidden = np.empty((depth, width * N))
    nn.write_features(network, states, features)
    nn.forward(network, theta, features, hidden, outputs)
    signals = batch_back_signals(network, theta, features, hidden, r)
    last = nn.units_by_points(hidden[depth - 1], width, N)
    top = output_inputs(network, last, features)
    changes = np.empty((width, N))
    for j in range(along.shape[0]):
        dW, db = nn.layer(network, along[j], depth)
        multiply_and_shift(dW, top, db, out[:, j])
        for index in range(depth):
            dW, db = nn.layer(network, along[j], index)
            below = features if index == 0 else nn.units_by_points(hidden[index - 1], width, N)
            multiply(dW, below, changes)
            for k in range(r):
                _add_products(signals[k * depth + index], changes, db, out[k, j])


@compiled
def _add_products(signal: Matrix, change: Matrix, shift: Vector, out: Vector) -> None:
    """Add the sum over the units of δ (change + shift), (N,)."""
    for i in range(signal.shape[0]):
        delta, row, b = signal[i], change[i], shift[i]
        for n in range(out.shape[0]):
            out[n] += delta[n] * (row[n] + b)


@compiled
def plan(trial: Trial, t: int, u: Vector) -> None:
    """Write the first input of the best plan, (m,); NaN where M is not positive definite."""
    search, gamma, m = trial.algorithm.search, trial.plant.gamma, u.shape[0]
    E, plans = search.elites, search.plans
    memory = trial.state.policy_memory.reshape(1 + E, -1, m)  # the mean, then the elites
    K, definite = memory.shape[1], True
    draws = Directions(np.empty((0, 0)), np.empty((0, 0)))
    if trial.network.kind != ModelKind.GAUSSIAN_PROCESS:
        definite, draws = _directions(trial, t)
    if not definite:
        u[:] = np.nan
        return
    if t % search.hold == 0:
        _drop(memory, 1)
    inputs, values = np.empty((E + plans, K, m)), np.full(E + plans, -np.inf)
    mean, spread = memory[0], np.full((K, m), gamma)
    inputs[:E] = memory[1:]
    blocks = trial.randomness.plans.shape[0]
    normals = trial.randomness.plans[t % blocks].reshape(search.iterations, plans, K, m)
    for iteration in range(search.iterations):
        for p in range(plans):
            inputs[E + p] = mean + spread * normals[iteration, p]
            _scale_inputs(inputs[E + p], gamma)
        # The elites of the step before are scored again with the present model; step 1 has none.
        first = 0 if iteration == 0 and t > 1 else E
        _score(trial, t, draws, inputs[first:], values[first:])
        best = np.argsort(-rounded(values), kind="mergesort")[:E]  # of equal ones the first
        inputs[:E], values[:E] = inputs[best].copy(), values[best].copy()
        _refit(mean, spread, inputs[:E])
    memory[1:] = inputs[:E]
    u[:] = inputs[0, 0] if values[0] > -np.inf else gamma * trial.randomness.ties[t]


@compiled
def _refit(mean: Matrix, spread: Matrix, elites: Stack) -> None:
    """Move mean and spread, (K, m), towards the elites, (E, K, m); a share is kept."""
    for k in range(mean.shape[0]):
        for j in range(mean.shape[1]):
            values = elites[:, k, j]
            mean[k, j] = SPREAD_KEPT * mean[k, j] + (1.0 - SPREAD_KEPT) * values.mean()
            spread[k, j] = SPREAD_KEPT * spread[k, j] + (1.0 - SPREAD_KEPT) * values.std()


@compiled
def rounded(values: Vector) -> Vector:
    """Return scores rounded to a share of the largest: among equal plans rounding must not choose.

    Plans that differ only after their end have equal scores.
    """
    largest = 0.0
    for value in values:
        if np.isfinite(value):
            largest = max(largest, abs(value))
    out = np.empty_like(values)
    for p in range(values.shape[0]):
        steps = np.rint(values[p] / (TIE_MARGIN * largest)) if largest > 0.0 else values[p]
        out[p] = steps if np.isfinite(values[p]) else values[p]
    return out


@compiled
def _scale_inputs(inputs: Matrix, gamma: float) -> None:
    """Give every input of a plan, (K, m), the norm γ."""
    for k in range(inputs.shape[0]):
        norm = np.sqrt(inner(inputs[k], inputs[k]))
        for j in range(inputs.shape[1]):
            inputs[k, j] *= gamma / norm


@compiled
def _directions(trial: Trial, t: int) -> tuple[bool, Directions]:
    """Return the directions of the parameters of step t, exact for the rows at task states."""
    states, count = trial.algorithm.search.task_states, trial.algorithm.search.task_count
    chosen = np.empty((count, states.shape[1]))
    for i in range(count):
        chosen[i] = states[(t * count + i) % states.shape[0]]
    rows = rows_at_states(trial.plant, trial.network, trial.state.theta, chosen)
    return directions(trial.state, trial.randomness.parameters, rows)


@compiled
def _score(trial: Trial, t: int, draws: Directions, inputs: Stack, values: Vector) -> None:
    """Write the scores of plans, (P, K, m); -∞ where a path leaves the bounds of a state."""
    plant, network, search = trial.plant, trial.network, trial.algorithm.search
    theta, stride, score = trial.state.theta, search.stride, search.score
    P, n, r = inputs.shape[0], search.steps // stride, plant.learned_rows.shape[0]
    starts = np.empty((P, trial.record.states.shape[1]))
    starts[:] = trial.record.states[t]
    places = (t + np.arange(n * stride)) // search.hold - t // search.hold
    rolled = roll(plant, network, theta, starts, inputs, places, 0, stride)
    points, d, per_state = rolled.points, starts.shape[1], n_next_points(network)
    if network.kind == ModelKind.GAUSSIAN_PROCESS:
        _score_process(trial, points, values)
    else:
        changes, R = np.empty((r, draws.rows.shape[0], points.shape[0])), r * per_state
        changes_along(plant, network, theta, points, draws.rows, changes)
        rows = np.empty((n * R, draws.rows.shape[0]))
        products, factor = np.empty((2, n * R, n * R))
        joint = score in (Score.JOINT, Score.TASK)
        scale = search.row_scale * (np.sqrt(stride) if joint else 1.0)
        if per_state > 1:
            scale /= np.sqrt(per_state)
        for p in range(P):
            for i in range(n * per_state):
                place = p * n * per_state + i
                weight = scale * domain_weight(search.domain, points[place, :d])
                for k in range(r):
                    for j in range(rows.shape[1]):
                        rows[i * r + k, j] = weight * changes[k, j, place]
            _write_products(score, rows, R, products)
            values[p] = score_of_rows(score, products, rows, draws.exact, R, factor)
    for p in range(P):
        values[p] = values[p] if rolled.inside[p] and np.isfinite(values[p]) else -np.inf


@compiled
def _write_products(score: int, rows: Matrix, r: int, out: Matrix) -> None:
    """Write the products that a score needs of rows, (N, ·), below the diagonal of (N, N)."""
    for i in range(rows.shape[0]):
        start = i if score == Score.TRACE else (i - i % r if score == Score.SUM else 0)
        for j in range(start, i + 1):
            out[i, j] = inner(rows[i], rows[j])


@compiled
def _score_process(trial: Trial, points: Matrix, values: Vector) -> None:
    """Write the scores of paths, (P,), with a Gaussian process; points, (P n, d), path by path."""
    network, state, search = trial.network, trial.state, trial.algorithm.search
    P, r = values.shape[0], trial.plant.learned_rows.shape[0]
    n = points.shape[0] // P
    N, weight = n * r, float(search.stride) if search.score == Score.JOINT else 1.0
    white = np.empty((P * N, network.process.n_samples[0]))
    features = np.empty((P * N, network.sizes[0]))
    gp.write_rows(network, state, r, points, white, features)
    numbers = gp.numbers_by_row(network, state.theta, r)
    products, factor, nothing = np.zeros((N, N)), np.empty((N, N)), np.empty((0, 0))
    counted = np.empty(P * n)
    for i in range(P * n):
        counted[i] = 1.0 if domain_weight(search.domain, points[i]) == 1.0 else 0.0
    for p in range(P):
        for i in range(N):
            for j in range(i % r, i + 1, r):
                a, b = p * N + i, p * N + j
                both = weight * counted[a // r] * counted[b // r]
                products[i, j] = 0.0
                if both > 0.0:
                    products[i, j] = both * gp.information(numbers, features, white, a, b)
        values[p] = score_of_rows(search.score, products, nothing, nothing, r, factor)


@compiled
def domain_weight(domain: Matrix, x: Vector) -> float:
    """Return the factor of the rows at a state, (d,): 1 in the box, less farther from it."""
    total = 0.0
    for j in range(x.shape[0]):
        value, period = x[j], domain[1, j]
        if period > 0.0:
            value -= period * np.rint(value / period)
        total += squared(max(abs(value) / domain[0, j] - 1.0, 0.0) / DOMAIN_MARGIN)
    weight: float = np.exp(-0.5 * total)
    return weight


@compiled
def score_of_rows(
    score: int, products: Matrix, rows: Matrix, exact: Matrix, r: int, factor: Matrix
) -> float:
    """Return the score of a path from J M⁻¹ Jᵀ, (N, N), and J W, (N, g + s), r rows for each state.

    It is the mean over the horizons that end at one of the states: what the i-th of n states adds
    counts (n - i) / n times, i from 0. ``factor``, (N, N), is overwritten by the Cholesky factor L
    of I + J M⁻¹ Jᵀ, and the exact products in ``rows`` by L⁻¹ times them.
    """
    N, g, total = factor.shape[0], exact.shape[0], 0.0
    block = r if score == Score.SUM else N
    for i in range(N):
        share = 1.0 - (i // r) / (N // r)
        if score == Score.TRACE:
            total += share * products[i, i]
            continue
        start = i - i % block
        for j in range(start, i + 1):
            value = products[i, j] - inner(factor[i, start:j], factor[j, start:j])
            factor[i, j] = np.sqrt(1.0 + value) if i == j else value / factor[j, j]
        total += share * 2.0 * np.log(factor[i, i])
    if score != Score.TASK:
        return total
    for i in range(N):
        row = rows[i, :g]
        for j in range(i):
            add_multiple(row, -factor[i, j], rows[j, :g])
        for j in range(g):
            row[j] /= factor[i, i]
    products = product(rows[:, :g], exact)
    total = 0.0
    for i in range(N):
        share = 1.0 - (i // r) / (N // r)
        total += share * inner(products[i], products[i])
    return total


@compiled
def plan_episodes(trial: Trial, t: int, u: Vector) -> None:
    """Write the next input of the best plan, (m,); NaN where a search finds M indefinite."""
    search = trial.algorithm.search
    hold, every = search.hold, search.replan_every
    last = max(1, t - t % every)
    memory = trial.state.policy_memory.reshape(1 + search.elites, -1, u.shape[0])
    if last < t:
        u[:] = memory[1, t // hold - last // hold]  # of the best elite
        return
    # The search itself drops the input whose time ends at this step.
    ended = t // hold - max(1, t - every) // hold
    _drop(memory, max(0, ended - (1 if t % hold == 0 else 0)))
    plan(trial, t, u)


@compiled
def _drop(memory: Stack, count: int) -> None:
    """Drop the first inputs of every plan, whose time has ended, and repeat the last."""
    final = memory.shape[1] - 1
    for k in range(final):
        memory[:, k] = memory[:, min(k + count, final)]
