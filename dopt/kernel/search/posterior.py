"""Accelerations at many states along draws of the parameters, in compiled code.

The parameters have the covariance M⁻¹ = U Uᵀ with U upper triangular, the inverse of the transposed
Cholesky factor of M. For a matrix Z, (q, s), of standard normal numbers divided by √s, W = U Z has
E[(J W)(J W)ᵀ] = J M⁻¹ Jᵀ: the covariance of accelerations from s numbers for each row of J. For the
rows of a matrix G the products with any other row are made exact: Z = [Q, (I - Q Qᵀ) Ω / √s] with
an orthonormal basis Q of the rows of G U.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel import network as nn
from dopt.kernel.compiler import compiled, contracted
from dopt.kernel.information.cholesky import (
    factorize,
    solve_columns,
    solve_transposed_columns,
)
from dopt.kernel.model import parameter_rows, write_features
from dopt.kernel.network_backward import batch_back_signals
from dopt.kernel.output_layer import output_inputs
from dopt.kernel.state_structs import Covariance, State
from dopt.kernel.structs import Network, Plant
from dopt.types import Matrix, Stack, Vector


class Directions(NamedTuple):
    """Directions W of the parameters along which the model is differentiated."""

    rows: Matrix  # Wᵀ, (g + s, q), the g exact ones first
    exact: Matrix  # R with Gᵀ = U⁻ᵀ Q R, (g, rows of G)


class Root(NamedTuple):
    """A root of M⁻¹ = U Uᵀ by a Cholesky factor, (q, q).

    It is that of M, whose inverse is Uᵀ, or that of M⁻¹ with its rows and columns in reverse
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
        _write_reversed(state.covariance, root.factor)
        if not factorize(root.factor):
            return False, found
    Z, random = np.empty((q, g + s)), normals / np.sqrt(s)
    if g > 0:
        Q, R = np.linalg.qr(_transposed_products(root, chosen.T.copy()))
        basis = Q.copy()
        random -= np.dot(basis, np.dot(basis.T, random))
        Z[:, :g] = basis
        found.exact[:] = R
    Z[:, g:] = random
    found.rows[:] = _products(root, Z).T
    return True, found


@compiled
def _transposed_products(root: Root, columns: Matrix) -> Matrix:
    """Return Uᵀ times columns, (q, k)."""
    if root.of_inverse:
        reversed_products: Matrix = np.dot(root.factor.T, columns[::-1].copy())
        return reversed_products[::-1].copy()
    solve_columns(root.factor, columns)
    return columns


@compiled
def _products(root: Root, columns: Matrix) -> Matrix:
    """Return U times columns, (q, k)."""
    if root.of_inverse:
        reversed_products: Matrix = np.dot(root.factor, columns[::-1].copy())
        return reversed_products[::-1].copy()
    solve_transposed_columns(root.factor, columns)
    return columns


@compiled
def _write_reversed(covariance: Covariance, out: Matrix) -> None:
    """Write M⁻¹ with its rows and columns in reverse order, (q, q)."""
    q = out.shape[0]
    for i in range(q):
        for j in range(i, q):
            value = covariance.upper[i, j]
            for n in range(covariance.n_pending[0]):
                value -= covariance.pending[n, i] * covariance.pending[n, j]
            out[q - 1 - i, q - 1 - j] = value
            out[q - 1 - j, q - 1 - i] = value


@compiled
def changes_along(
    plant: Plant, network: Network, theta: Vector, states: Matrix, along: Matrix, out: Stack
) -> None:
    """Write J W, (r, s, N), at points, (N, ·), for directions Wᵀ, (s, q)."""
    N, r = states.shape[0], out.shape[0]
    if network.kind != ModelKind.MLP:
        rows, value = np.empty((r, theta.shape[0])), np.empty(r)
        for n in range(N):
            parameter_rows(plant, network, theta, states[n], rows, value)
            for k in range(r):
                out[k, :, n] = np.dot(along, rows[k])
        return
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    features, outputs = np.empty((network.feature_kinds.shape[0], N)), np.empty((r, N))
    hidden = np.empty((depth, width * N))
    write_features(network, states, features)
    nn.forward(network, theta, features, hidden, outputs)
    signals = batch_back_signals(network, theta, features, hidden, r)
    last = nn.units_by_points(hidden[depth - 1], width, N)
    top = output_inputs(network, last, features)
    change = np.empty((width, N))
    for j in range(along.shape[0]):
        dW, db = nn.layer(network, along[j], depth)
        np.dot(dW, top, outputs)
        for k in range(r):
            for n in range(N):
                out[k, j, n] = outputs[k, n] + db[k]
        for index in range(depth):
            dW, db = nn.layer(network, along[j], index)
            below = features if index == 0 else nn.units_by_points(hidden[index - 1], width, N)
            np.dot(dW, below[: dW.shape[1]], change)
            for k in range(r):
                _add_products(signals[k * depth + index], change, db, out[k, j])


@contracted
def _add_products(signal: Matrix, change: Matrix, shift: Vector, out: Vector) -> None:
    """Add the sum over the units of δ (change + shift), (N,)."""
    for i in range(signal.shape[0]):
        delta, row, b = signal[i], change[i], shift[i]
        for n in range(out.shape[0]):
            out[n] += delta[n] * (row[n] + b)
