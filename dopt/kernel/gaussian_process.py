"""Gaussian processes in compiled code: kernels, posterior, evidence and covariances along paths.

Row k of the learned accelerations has the kernel

    k(x, x') = s² exp(-½ Σ_j w_j (φ_j - φ'_j)²) + Σ_j l_j φ_j φ'_j + c

of the p features φ, and noise of variance ν. Its numbers are w, s², l, c and ν, (2p + 3,). All rows
share one kernel where it is fixed; otherwise the flat parameters θ end with the numbers of each.

θ begins with the features of the samples, (p, C), and the weights α of the mean, (r, C), with room
for C samples, of which n are taken (:class:`dopt.models.GaussianProcess`).

======  =====================================================  =====
symbol  meaning                                                shape
======  =====================================================  =====
K       kernel between samples                                 n × n
L       Cholesky factor of K + νI                              n × n
z       L⁻¹y, with y the observed accelerations of a row       n
α       L⁻ᵀz                                                   n
======  =====================================================  =====

Reference: C. Rasmussen and C. Williams, "Gaussian processes for machine learning" (2006), chapters
2 and 5.
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import called_from_python, compiled, copy_into, squared
from dopt.kernel.linear_algebra import (
    factorize,
    solve_columns,
    solve_lower,
    solve_lower_transposed,
    write_inverse,
)
from dopt.kernel.network import exp_parts, features_at
from dopt.kernel.structs import Evaluation, Network, Posterior, State
from dopt.kernel.vectors import add_multiple, inner, multiply_add
from dopt.types import Integers, Matrix, Vector

LITTLE = 0.1
"""Variance of what a sample shows, in units of its noise, below which it adds little."""

SMALLEST_EXPONENT = -700.0
"""Exponents below it count as it: exp is 1e-304."""


@compiled
def exp_of_negative(x: float) -> float:
    """Return exp(x) for x ≤ 0, in operations that the compiler turns into vector instructions."""
    power, p = exp_parts(SMALLEST_EXPONENT if x < SMALLEST_EXPONENT else x)
    value: float = multiply_add(power, p, power)
    return value


@compiled
def sample_features(network: Network, theta: Vector) -> Matrix:
    """Return a view of the features of the samples, (p, C), of which n are taken."""
    p, room = network.sizes[0], network.process.room
    features: Matrix = theta[: p * room].reshape(p, room)
    return features


@compiled
def mean_weights(network: Network, theta: Vector, r: int) -> Matrix:
    """Return a view of the weights α of the samples, (r, C)."""
    p, room = network.sizes[0], network.process.room
    weights: Matrix = theta[p * room : (p + r) * room].reshape(r, room)
    return weights


@compiled
def numbers_of(network: Network, theta: Vector, r: int) -> Matrix:
    """Return the numbers of the kernels, (1, 2p + 3) where all rows share one, or (r, 2p + 3)."""
    process = network.process
    if process.shared.shape[0] > 0:
        return process.shared
    p = network.sizes[0]
    numbers: Matrix = theta[(p + r) * process.room :].reshape(r, 2 * p + 3)
    return numbers


@compiled
def write_kernel(numbers: Vector, phi: Vector, others: Matrix, first: int, out: Vector) -> None:
    """Write the kernel, (n,), between features (p,) and n columns of (p, ·) from ``first`` on."""
    p, last = phi.shape[0], first + out.shape[0]
    for i in range(out.shape[0]):
        out[i] = 0.0
    for j in range(p):
        w, at, row = numbers[j], phi[j], others[j, first:last]
        for i in range(out.shape[0]):
            apart = row[i] - at
            out[i] += w * apart * apart
    size = numbers[p]
    for i in range(out.shape[0]):
        out[i] = size * exp_of_negative(-0.5 * out[i])
    for j in range(p):
        slope, row = numbers[p + 1 + j] * phi[j], others[j, first:last]
        if slope != 0.0:
            for i in range(out.shape[0]):
                out[i] += slope * row[i]
    constant = numbers[2 * p + 1]
    if constant != 0.0:
        for i in range(out.shape[0]):
            out[i] += constant


@compiled
def factor_of(posterior: Posterior, g: int) -> Matrix:
    """Return a view of the factor of a kernel that is in force, (C, C)."""
    factor: Matrix = posterior.factors[posterior.first[0] + g]
    return factor


@compiled
def prior_variance(numbers: Vector, phi: Vector) -> float:
    """Return the kernel at features (p,)."""
    p = phi.shape[0]
    value: float = numbers[p] + numbers[2 * p + 1]
    for j in range(p):
        value += numbers[p + 1 + j] * phi[j] * phi[j]
    return value


@compiled
def write_mean(network: Network, theta: Vector, x: Vector, out: Vector) -> None:
    """Write the posterior mean, (r,), at a state."""
    phi = np.empty(network.sizes[0])
    features_at(network, x, phi)
    write_mean_at(network, theta, phi, np.empty(network.process.n_samples[0]), out)


@compiled
def write_mean_at(network: Network, theta: Vector, phi: Vector, row: Vector, out: Vector) -> None:
    """Write the posterior mean, (r,), at features (p,); ``row``, (n,), is overwritten."""
    r = out.shape[0]
    numbers, others = numbers_of(network, theta, r), sample_features(network, theta)
    alpha = mean_weights(network, theta, r)
    for k in range(r):
        if k < numbers.shape[0]:
            write_kernel(numbers[k], phi, others, 0, row)
        out[k] = inner(row, alpha[k, : row.shape[0]])


@called_from_python
def add_sample(
    network: Network, theta: Vector, posterior: Posterior, x: Vector, target: Vector
) -> None:
    """Add the accelerations observed at a state, (r,): a row of each L and of z, and all of α.

    Where not all samples of the horizon have room, one that adds little information is merged.
    """
    n, r, process = network.process.n_samples[0], target.shape[0], network.process
    phi, p = np.empty(network.sizes[0]), network.sizes[0]
    features_at(network, x, phi)
    if n == process.room:
        _merge(network, theta, posterior, phi, target)
        return
    numbers, others, added = numbers_of(network, theta, r), sample_features(network, theta), 0.0
    for g in range(numbers.shape[0]):
        factor = factor_of(posterior, g)
        row = factor[n, :n]
        write_kernel(numbers[g], phi, others, 0, row)
        solve_lower(factor, n, factor[n : n + 1])
        noise = numbers[g, 2 * p + 2]
        # The variance of a new observation is at least the variance of its noise.
        rest = prior_variance(numbers[g], phi) + noise - inner(row, row)
        factor[n, n] = np.sqrt(max(rest, noise))
        added = max(added, rest / noise - 1.0)
    if n >= process.selects_from and added < LITTLE:
        _merge(network, theta, posterior, phi, target)
        return
    posterior.counts[n] = 1.0
    copy_into(target, posterior.targets[:, n])
    copy_into(phi, others[:, n])
    network.process.n_samples[0] = n + 1
    for k in range(r):
        factor = factor_of(posterior, k % numbers.shape[0])
        known = inner(factor[n, :n], posterior.solved[k, :n])
        posterior.solved[k, n] = (target[k] - known) / factor[n, n]
    _write_weights(network, theta, posterior, r)


@compiled
def _merge(
    network: Network, theta: Vector, posterior: Posterior, phi: Vector, target: Vector
) -> None:
    """Make accelerations, (r,), part of the mean of the nearest sample.

    They are moved there by what the model says; they count from the next :func:`refactor` on.
    """
    n, r, p = network.process.n_samples[0], target.shape[0], phi.shape[0]
    numbers, others = numbers_of(network, theta, r), sample_features(network, theta)
    nearest, row = _nearest(numbers, phi, others, np.arange(n)), np.empty(n)
    here, there, at = np.empty(r), np.empty(r), np.empty(p)
    copy_into(others[:, nearest], at)
    write_mean_at(network, theta, phi, row, here)
    write_mean_at(network, theta, at, row, there)
    count = posterior.counts[nearest]
    for k in range(r):
        mean = posterior.targets[k, nearest]
        posterior.targets[k, nearest] += (target[k] - here[k] + there[k] - mean) / (count + 1.0)
    posterior.counts[nearest] = count + 1.0


@compiled
def _nearest(numbers: Matrix, phi: Vector, others: Matrix, places: Integers) -> int:
    """Return which of some columns of (p, ·) is nearest to features (p,), by the sum of all w."""
    nearest, least = places[0], np.inf
    for place in places:
        square = 0.0
        for j in range(phi.shape[0]):
            square += numbers[:, j].sum() * squared(others[j, place] - phi[j])
        if square < least:
            nearest, least = place, square
    return int(nearest)


@called_from_python
def thin(network: Network, theta: Vector, posterior: Posterior) -> None:
    """Keep the samples that add most information, half of the room; merge the others into them.

    Each next sample is the one with the largest variance in units of the noise, given those before
    it, up to :data:`LITTLE`. Call :func:`refactor` afterwards.
    """
    n, r, p = network.process.n_samples[0], posterior.targets.shape[0], network.sizes[0]
    keep, at, targets = network.process.selects_from, np.empty(p), posterior.targets
    if n <= keep or keep == network.process.room:
        return
    numbers, phi = numbers_of(network, theta, r), sample_features(network, theta)
    G, rows, means = numbers.shape[0], np.zeros((numbers.shape[0], keep, n)), np.empty((r, n))
    left, chosen, taken = np.empty((G, n)), np.empty(keep, np.int64), np.zeros(n, np.bool_)
    row, value = np.empty(n), np.empty(r)
    for i in range(n):
        copy_into(phi[:, i], at)
        write_mean_at(network, theta, at, row, value)
        means[:, i] = value
        for g in range(G):
            left[g, i] = prior_variance(numbers[g], at) / numbers[g, 2 * p + 2]
    m = 0
    while m < keep:
        best = 0
        for i in range(n):
            if taken[best] or (not taken[i] and left[:, i].max() > left[:, best].max()):
                best = i
        if taken[best] or left[:, best].max() < LITTLE:
            break
        taken[best], chosen[m] = True, best
        copy_into(phi[:, best], at)
        for g in range(G):
            row, noise = rows[g, m], numbers[g, 2 * p + 2]
            write_kernel(numbers[g], at, phi, 0, row)
            for k in range(m):
                add_multiple(row, -rows[g, k, best], rows[g, k])
            scale = 1.0 / np.sqrt(noise * (left[g, best] + 1.0 / posterior.counts[best]))
            for i in range(n):
                row[i] *= scale
                left[g, i] -= row[i] * row[i] / noise
        m += 1
    for i in range(n):
        if taken[i]:
            continue
        copy_into(phi[:, i], at)
        nearest = _nearest(numbers, at, phi, chosen[:m])
        share = posterior.counts[i] / (posterior.counts[nearest] + posterior.counts[i])
        for k in range(r):
            moved = targets[k, i] - means[k, i] + means[k, nearest]
            targets[k, nearest] += share * (moved - targets[k, nearest])
        posterior.counts[nearest] += posterior.counts[i]
    order = np.sort(chosen[:m])
    for i in range(m):
        posterior.counts[i] = posterior.counts[order[i]]
        copy_into(targets[:, order[i]], targets[:, i])
        copy_into(phi[:, order[i]], phi[:, i])
    phi[:, m:n] = 0.0
    mean_weights(network, theta, r)[:, m:n] = 0.0
    network.process.n_samples[0] = m


@compiled
def _write_weights(network: Network, theta: Vector, posterior: Posterior, r: int) -> None:
    """Write α of all rows."""
    n, alpha = network.process.n_samples[0], mean_weights(network, theta, r)
    G = numbers_of(network, theta, r).shape[0]
    for g in range(G):
        columns = np.empty(((r + G - 1 - g) // G, n))
        for i in range(columns.shape[0]):
            copy_into(posterior.solved[g + i * G, :n], columns[i])
        solve_lower_transposed(factor_of(posterior, g), n, columns)
        for i in range(columns.shape[0]):
            copy_into(columns[i], alpha[g + i * G, :n])


@called_from_python
def refactor(network: Network, theta: Vector, posterior: Posterior) -> bool:
    """Write L, z and α of all samples for new numbers of the kernels.

    Returns whether all K + νI are positive definite.
    """
    r, n, definite = posterior.targets.shape[0], network.process.n_samples[0], True
    numbers, phi = numbers_of(network, theta, r), sample_features(network, theta)
    for g in range(numbers.shape[0]):
        K = np.empty((n, n))
        _write_covariance(numbers[g], phi, posterior.counts[:n], K, K)
        definite = factorize(K) and definite
        for i in range(n):
            copy_into(K[i, : i + 1], factor_of(posterior, g)[i, : i + 1])
    for k in range(r):
        copy_into(posterior.targets[k, :n], posterior.solved[k, :n])
        factor = factor_of(posterior, k % numbers.shape[0])
        solve_lower(factor, n, posterior.solved[k : k + 1])
    _write_weights(network, theta, posterior, r)
    return definite


@compiled
def _write_covariance(numbers: Vector, phi: Matrix, counts: Vector, E: Matrix, K: Matrix) -> None:
    """Write the upper triangles of s² exp(...), (n, n), and of K + ν/counts, which may be one."""
    p, n = phi.shape[0], counts.shape[0]
    exponential = numbers.copy()
    exponential[p + 1 : 2 * p + 2] = 0.0
    at = np.empty(p)
    for i in range(n):
        copy_into(phi[:, i], at)
        write_kernel(exponential, at, phi, i, E[i, i:])
        row, smooth = K[i, i:], E[i, i:]
        for b in range(row.shape[0]):
            row[b] = smooth[b] + numbers[2 * p + 1]
        for j in range(p):
            add_multiple(row, numbers[p + 1 + j] * at[j], phi[j, i:n])
        row[0] += numbers[2 * p + 2] / counts[i]


@called_from_python
def negative_evidence(
    numbers: Vector, phi: Matrix, y: Vector, counts: Vector, slope: Vector
) -> float:
    """Return -log p(y | numbers) and write its derivatives by the logarithms of the numbers.

    ``phi`` (p, n) are features, y (n,) the accelerations of one row, each the mean of so many
    observations. It is infinite where K + νI is not positive definite.
    """
    p, n = phi.shape[0], y.shape[0]
    E, K, A = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    _write_covariance(numbers, phi, counts, E, K)
    if not factorize(K):
        return np.inf
    alpha = y.copy()
    value: float = 0.5 * n * np.log(2.0 * np.pi)
    for i in range(n):
        value += np.log(K[i, i])
    solve_lower(K, n, alpha.reshape(1, n))
    value += 0.5 * inner(alpha, alpha)
    solve_lower_transposed(K, n, alpha.reshape(1, n))
    write_inverse(K, A)
    slope[:] = 0.0
    weighted, squares = np.empty(n), np.empty(n)
    for i in range(n):
        row, products, square = A[i, i:], weighted[: n - i], squares[: n - i]
        add_multiple(row, -alpha[i], alpha[i:])
        slope[2 * p + 2] += 0.5 * row[0] / counts[i]
        row[0] *= 0.5
        for b in range(row.shape[0]):
            products[b] = row[b] * E[i, i + b]
            slope[p] += products[b]
            slope[2 * p + 1] += row[b]
        for j in range(p):
            values, at = phi[j, i:n], phi[j, i]
            for b in range(values.shape[0]):
                square[b] = (values[b] - at) * (values[b] - at)
            slope[j] -= 0.5 * inner(products, square)
            slope[p + 1 + j] += at * inner(row, values)
    for j in range(2 * p + 3):
        if j != p:
            slope[j] *= numbers[j]
    return value


@compiled
def whitened(
    network: Network, theta: Vector, posterior: Posterior, r: int, g: int, phi: Matrix
) -> Matrix:
    """Return L⁻¹k for features (N, p), one point to a row, (N, n)."""
    N, n = phi.shape[0], network.process.n_samples[0]
    numbers, others = numbers_of(network, theta, r)[g], sample_features(network, theta)
    rows = np.empty((N, n))
    for i in range(N):
        write_kernel(numbers, phi[i], others, 0, rows[i])
    columns = rows.T.copy()
    solve_columns(factor_of(posterior, g)[:n, :n], columns)
    return columns.T.copy()


@compiled
def write_rows(
    network: Network, state: State, r: int, points: Matrix, rows: Matrix, features: Matrix
) -> None:
    """Write L⁻¹k, (N r, n), and the features, (N r, p), at points, (N, d), r rows to a point."""
    N, numbers = points.shape[0], numbers_of(network, state.theta, r)
    phi = np.empty((N, network.sizes[0]))
    for i in range(N):
        features_at(network, points[i], phi[i])
    for g in range(numbers.shape[0]):
        white = whitened(network, state.theta, state.posterior, r, g, phi)
        for i in range(N):
            for k in range(g, r, numbers.shape[0]):
                copy_into(white[i], rows[i * r + k])
                copy_into(phi[i], features[i * r + k])


@compiled
def numbers_by_row(network: Network, theta: Vector, r: int) -> Matrix:
    """Return the numbers of the kernel of each row, (r, 2p + 3)."""
    numbers = numbers_of(network, theta, r)
    by_row = np.empty((r, numbers.shape[1]))
    for k in range(r):
        by_row[k] = numbers[k % numbers.shape[0]]
    return by_row


@compiled
def information(numbers: Matrix, features: Matrix, rows: Matrix, a: int, b: int) -> float:
    """Return the posterior covariance of two rows (:func:`write_rows`) by the noise.

    ``numbers`` are (r, 2p + 3); the covariance of different components is 0.
    """
    k = a % numbers.shape[0]
    if k != b % numbers.shape[0]:
        return 0.0
    value = posterior_covariance(numbers[k], features[a], features[b], rows[a], rows[b])
    share: float = max(value, 0.0 if a == b else -np.inf) / numbers[k, numbers.shape[1] - 1]
    return share


@compiled
def posterior_covariance(
    numbers: Vector, a: Vector, b: Vector, of_a: Vector, of_b: Vector
) -> float:
    """Return the covariance of a row at features (p,), given L⁻¹k, (n,), of both."""
    p, square = a.shape[0], 0.0
    value: float = numbers[2 * p + 1]
    for j in range(p):
        square += numbers[j] * (a[j] - b[j]) * (a[j] - b[j])
        value += numbers[p + 1 + j] * a[j] * b[j]
    value += numbers[p] * exp_of_negative(-0.5 * square) - inner(of_a, of_b)
    return value


@compiled
def add_to_points(network: Network, theta: Vector, r: int, points: Evaluation) -> None:
    """Write the kernels between the points and the samples that came since the last call."""
    numbers, phi = numbers_of(network, theta, r), sample_features(network, theta)
    G, at, last = numbers.shape[0], np.empty(network.sizes[0]), network.process.n_samples[0]
    for n in range(points.n_basis[0], last):
        copy_into(phi[:, n], at)
        for block in range(points.bounds[2]):
            for g in range(G):
                out = points.basis[G * block + g, n]
                write_kernel(numbers[g], at, points.features[block], 0, out)
    points.n_basis[0] = last
