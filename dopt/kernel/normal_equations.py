"""Normal equations of the least-squares fit of a network to many samples, in compiled code.

JᵀJ over N samples and r outputs, without J. In a layer the gradient of output k is δᵏ ⊗ h, with h
the activations below, completed by 1, and δᵏ the derivative with respect to the pre-activations. A
block of JᵀJ that belongs to layers a and b is then

    Σ_n (Σ_k δᵏ_a,n δᵏ_b,nᵀ) ⊗ (h_a,n h_b,nᵀ),

one product of two matrices with N columns whose rows are pairs of units. The sum over the outputs
is taken before the product, so that the blocks of hidden layers cost the same for any r, and where
a = b pairs are symmetric on both sides.
"""

from __future__ import annotations

import numpy as np

from dopt.algorithm import ModelKind
from dopt.kernel import network as nn
from dopt.kernel.compiler import compiled, squared
from dopt.kernel.model import squared_error, write_normal_equations
from dopt.kernel.network import batch_back_signals, output_inputs
from dopt.kernel.structs import Network, Plant
from dopt.kernel.vectors import inner_products
from dopt.types import Matrix, Stack, Vector


@compiled
def normal_equations(
    network: Network, theta: Vector, inputs: Matrix, targets: Matrix, normal: Matrix, slope: Vector
) -> float:
    """Write JᵀJ, (q, q), and Jᵀe, (q,), over all samples; return the sum of squares of e.

    ``inputs`` (p, N) are features, ``targets`` (r, N) accelerations, and e = y - a_θ(x).
    """
    total, errors, hidden = errors_of(network, theta, inputs, targets)
    signals = batch_back_signals(network, theta, inputs, hidden, targets.shape[0])
    below, depth = _completed(network, inputs, hidden), network.offsets.shape[0] - 1
    _write_slope(network, below, signals, errors, slope)
    for a in range(depth):
        for b in range(a, depth):
            _hidden_block(network, below, signals, a, b, normal)
    _output_blocks(network, below, signals, normal)
    for i in range(normal.shape[0]):
        for j in range(i):
            normal[i, j] = normal[j, i]
    return total


@compiled
def write_normal(
    plant: Plant,
    network: Network,
    theta: Vector,
    features: Matrix,
    targets: Matrix,
    normal: Matrix,
    slope: Vector,
) -> float:
    """Write JᵀJ, (q, q), and Jᵀe, (q,), of a model of any kind; return ‖e‖²."""
    if network.kind == ModelKind.MLP:
        return normal_equations(network, theta, features, targets, normal, slope)
    write_normal_equations(plant, network, theta, features, targets, normal, slope)
    return squared_error(plant, network, theta, features, targets)


@compiled
def sum_of_squares(
    plant: Plant, network: Network, theta: Vector, features: Matrix, targets: Matrix
) -> float:
    """Return ‖e‖² of a model of any kind."""
    if network.kind == ModelKind.MLP:
        return errors_of(network, theta, features, targets)[0]
    return squared_error(plant, network, theta, features, targets)


@compiled
def errors_of(
    network: Network, theta: Vector, inputs: Matrix, targets: Matrix
) -> tuple[float, Matrix, Matrix]:
    """Return ‖e‖², e = y - a_θ(x), (r, N), and the activations of every hidden layer, (L, w N)."""
    n = inputs.shape[1]
    hidden = np.empty((network.offsets.shape[0] - 1, network.sizes[1] * n))
    errors = np.empty_like(targets)
    nn.forward(network, theta, inputs, hidden, errors)
    total = 0.0
    for k in range(errors.shape[0]):
        for i in range(n):
            errors[k, i] = targets[k, i] - errors[k, i]
            total += squared(errors[k, i])
    return total, errors, hidden


@compiled
def write_products(
    network: Network, theta: Vector, inputs: Matrix, hidden: Matrix, weights: Matrix, out: Vector
) -> None:
    """Write Jᵀv, (q,), for v (r, N), given the activations of :func:`errors_of`."""
    signals = batch_back_signals(network, theta, inputs, hidden, weights.shape[0])
    _write_slope(network, _completed(network, inputs, hidden), signals, weights, out)


@compiled
def _completed(network: Network, inputs: Matrix, hidden: Matrix) -> Stack:
    """Return the inputs of every layer and a row of ones, (L + 1, most of these + 1, N)."""
    depth, width, n = network.offsets.shape[0] - 1, network.sizes[1], inputs.shape[1]
    below = np.empty((depth + 1, np.max(network.layer_inputs) + 1, n))
    for index in range(depth + 1):
        units = network.layer_inputs[index]
        values = inputs if index == 0 else nn.units_by_points(hidden[index - 1], width, n)
        if index == depth:
            values = output_inputs(network, values, inputs)
        for i in range(units):
            below[index, i] = values[i]
        below[index, units] = 1.0
    return below


@compiled
def _write_slope(
    network: Network, below: Stack, signals: Stack, errors: Matrix, slope: Vector
) -> None:
    """Write Jᵀe."""
    depth, width, n = network.offsets.shape[0] - 1, network.sizes[1], errors.shape[1]
    weighted = np.empty((width, n))
    for index in range(depth):
        weighted[:] = 0.0
        for k in range(errors.shape[0]):
            _add_weighted(signals[k * depth + index], errors[k], weighted)
        _write_layer(network, weighted, below[index], index, slope)
    _write_layer(network, errors, below[depth], depth, slope)


@compiled
def _add_weighted(signal: Matrix, weights: Vector, out: Matrix) -> None:
    for i in range(out.shape[0]):
        row, values = out[i], signal[i]
        for n in range(weights.shape[0]):
            row[n] += values[n] * weights[n]


@compiled
def _write_layer(
    network: Network, signal: Matrix, below: Matrix, index: int, slope: Vector
) -> None:
    dW, db = nn.layer(network, slope, index)
    units = network.layer_inputs[index]
    products = np.empty((signal.shape[0], units + 1))
    inner_products(signal, below[: units + 1], products)
    for i in range(db.shape[0]):
        db[i] = products[i, units]
        for j in range(units):
            dW[i, j] = products[i, j]


@compiled
def _place(network: Network, index: int, i: int, j: int) -> int:
    """Return the place in θ of the weight of activation j for unit i; its bias comes last."""
    n_in, n_out = network.layer_inputs[index], network.sizes[index + 1]
    place: int = network.offsets[index] + (n_in * n_out + i if j == n_in else i * n_in + j)
    return place


@compiled
def _pairs(first: Matrix, second: Matrix, symmetric: bool, add: bool, out: Matrix) -> None:
    """Write, or add, the products of all rows of two matrices, (pairs, N)."""
    pair = 0
    for i in range(first.shape[0]):
        for j in range(i if symmetric else 0, second.shape[0]):
            a, b, row = first[i], second[j], out[pair]
            if add:
                for n in range(row.shape[0]):
                    row[n] += a[n] * b[n]
            else:
                for n in range(row.shape[0]):
                    row[n] = a[n] * b[n]
            pair += 1


@compiled
def _hidden_block(
    network: Network, below: Stack, signals: Stack, a: int, b: int, normal: Matrix
) -> None:
    """Write the block of hidden layers a ≤ b, above the diagonal."""
    depth, width, n = network.offsets.shape[0] - 1, network.sizes[1], below.shape[2]
    r, symmetric = signals.shape[0] // depth, a == b
    lower, upper = network.layer_inputs[a] + 1, network.layer_inputs[b] + 1
    n_units = width * (width + 1) // 2 if symmetric else width * width
    n_below = lower * (lower + 1) // 2 if symmetric else lower * upper
    left, right = np.empty((n_units, n)), np.empty((n_below, n))
    for k in range(r):
        _pairs(signals[k * depth + a], signals[k * depth + b], symmetric, k > 0, left)
    _pairs(below[a, :lower], below[b, :upper], symmetric, False, right)
    products = np.empty((n_units, n_below))
    inner_products(left, right, products)
    row = 0
    for i in range(width):
        for j in range(i if symmetric else 0, width):
            column = 0
            for s in range(lower):
                for v in range(s if symmetric else 0, upper):
                    value = products[row, column]
                    _write(normal, _place(network, a, i, s), _place(network, b, j, v), value)
                    if symmetric:
                        _write(normal, _place(network, a, i, v), _place(network, b, j, s), value)
                    column += 1
            row += 1


@compiled
def _write(normal: Matrix, i: int, j: int, value: float) -> None:
    normal[min(i, j), max(i, j)] = value


@compiled
def _output_blocks(network: Network, below: Stack, signals: Stack, normal: Matrix) -> None:
    """Write the blocks of the output layer with itself and with the hidden ones."""
    depth, width, n = network.offsets.shape[0] - 1, network.sizes[1], below.shape[2]
    r, top = signals.shape[0] // depth, network.layer_inputs[depth] + 1
    last = below[depth, :top]
    own = np.empty((top, top))
    inner_products(last, last, own)
    start, stop = network.offsets[depth], normal.shape[0]
    for i in range(start, stop):
        for j in range(i, stop):
            normal[i, j] = 0.0
    for k in range(r):
        for s in range(top):
            for v in range(s, top):
                i, j = _place(network, depth, k, s), _place(network, depth, k, v)
                _write(normal, i, j, own[s, v])
        for index in range(depth):
            units = network.layer_inputs[index] + 1
            rows = np.empty((width * units, n))
            _pairs(signals[k * depth + index], below[index, :units], False, False, rows)
            products = np.empty((width * units, top))
            inner_products(rows, last, products)
            for i in range(width):
                for s in range(units):
                    for v in range(top):
                        normal[_place(network, index, i, s), _place(network, depth, k, v)] = (
                            products[i * units + s, v]
                        )
