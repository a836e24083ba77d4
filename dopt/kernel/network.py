"""Networks in compiled code: values and gradients, for batches and single states.

In the backward passes δ is the derivative of an output with respect to the pre-activations of a
layer, and h the activations. Derivatives along a direction of the point are taken forward over
reverse: a dot marks them.

Output layer: its inputs are the last hidden layer h; where inputs of the system multiply it
(:class:`dopt.models.AffineMLP`), they are (h, h u₁, ..., h u_m, u) with u the last features.

tanh x = -e/(2 + e), e = exp(-2|x|) - 1, with the sign of x; the compiler turns it into vector
instructions in both precisions. exp is 2^k (1 + p(r)) with r = -2|x| - k ln 2, |r| ≤ ln 2 / 2, and
p the Taylor polynomial of exp(r) - 1. The relative error is a few units in the last place
everywhere; NaN stays NaN.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numba.extending import overload

from dopt.algorithm import FeatureKind
from dopt.kernel.compiler import compiled, copy_into, power_of_two, squared
from dopt.kernel.structs import Network
from dopt.kernel.vectors import (
    add_multiple,
    add_product,
    inner_products,
    multiply,
    multiply_add,
    multiply_and_shift,
)
from dopt.types import Matrix, NumbaType, Real, Scalar, Stack, Vector

# Double precision. Adding 1.5 * 2^52 leaves the nearest integer in the low bits; the high part of
# ln 2 ends in zeros, so that its product with k is exact.
LOG2_E = 1.4426950408889634
LN2_HIGH = 6.93147180369123816490e-01
LN2_LOW = 1.90821492927058770002e-10
ROUND = 6755399441055744.0
SATURATION = 20.0
C = tuple(1.0 / math.factorial(n) for n in range(14))

# The same in single precision.
LOG2_E_SINGLE = np.float32(LOG2_E)
LN2_HIGH_SINGLE = np.float32(0.693359375)
LN2_LOW_SINGLE = np.float32(-2.12194440e-4)
ROUND_SINGLE = np.float32(12582912.0)
SATURATION_SINGLE = np.float32(10.0)
C_SINGLE = tuple(np.float32(c) for c in C[:9])
ZERO, ONE, TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)


def tanh(x: Scalar) -> Scalar:
    """Return tanh x in the precision of x."""
    return _tanh_single(x) if isinstance(x, np.float32) else _tanh_double(x)


@overload(tanh, strict=False)
def _tanh(x: NumbaType) -> NumbaType:
    if x == types.float32:
        return lambda x: _tanh_single(x)
    return lambda x: _tanh_double(x)


@compiled
def exp_parts(y: float) -> tuple[float, float]:
    """Return 2^k and p with exp(y) = 2^k (1 + p), for |y| up to 700."""
    shifted = multiply_add(y, LOG2_E, ROUND)
    k = shifted - ROUND
    r = multiply_add(k, -LN2_LOW, multiply_add(k, -LN2_HIGH, y))
    p = C[13]
    for n in (12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2):
        p = multiply_add(p, r, C[n])
    p = multiply_add(p * r, r, r)
    power: float = power_of_two(shifted)
    return power, p


@compiled
def _tanh_double(x: float) -> float:
    size = abs(x)
    size = SATURATION if size > SATURATION else size
    power, p = exp_parts(-2.0 * size)
    e: float = multiply_add(power, p, power - 1.0)
    value = -e / (2.0 + e)
    return value if x >= 0.0 else -value


@compiled
def _tanh_single(x: np.float32) -> np.float32:
    size = abs(x)
    size = SATURATION_SINGLE if size > SATURATION_SINGLE else size
    y = -TWO * size
    shifted = multiply_add(y, LOG2_E_SINGLE, ROUND_SINGLE)
    k = shifted - ROUND_SINGLE
    r = multiply_add(k, -LN2_LOW_SINGLE, multiply_add(k, -LN2_HIGH_SINGLE, y))
    p = C_SINGLE[8]
    for n in (7, 6, 5, 4, 3, 2):
        p = multiply_add(p, r, C_SINGLE[n])
    p = multiply_add(p * r, r, r)
    power: np.float32 = power_of_two(shifted)
    e: np.float32 = multiply_add(power, p, power - ONE)
    value: np.float32 = -e / (TWO + e)
    return value if x >= ZERO else -value


@compiled
def output_inputs(network: Network, hidden: Real, inputs: Real) -> Real:
    """Return the inputs of the output layer, (·, n), for the last hidden layer, (w, n).

    ``inputs`` (p, n) are the features.
    """
    m = network.n_factors
    if m == 0:
        return hidden
    w, n = hidden.shape
    first = inputs.shape[0] - m
    out = np.empty(((1 + m) * w + m, n), hidden.dtype)
    for i in range(w):
        for s in range(n):
            out[i, s] = hidden[i, s]
    for j in range(m):
        for s in range(n):
            u = inputs[first + j, s]
            out[(1 + m) * w + j, s] = u
            for i in range(w):
                out[(1 + j) * w + i, s] = hidden[i, s] * u
    return out


@compiled
def sum_over_factors(m: int, slopes: Matrix, inputs: Matrix, out: Matrix) -> None:
    """Write derivatives by the last hidden layer, (w, n), given those by :func:`output_inputs`."""
    w, n = out.shape
    first = inputs.shape[0] - m
    for i in range(w):
        for s in range(n):
            out[i, s] = slopes[i, s]
        for j in range(m):
            for s in range(n):
                out[i, s] += inputs[first + j, s] * slopes[(1 + j) * w + i, s]


@compiled
def output_inputs_at(network: Network, hidden: Vector, phi: Vector) -> Vector:
    """Return the inputs of the output layer at one point, given its last hidden layer, (w,)."""
    if network.n_factors == 0:
        return hidden
    return output_inputs(network, hidden.reshape(-1, 1), phi.reshape(-1, 1))[:, 0].copy()


@compiled
def output_slopes(
    network: Network, theta: Vector, phi: Vector, component: int, out: Vector
) -> None:
    """Write the derivatives of output k by the last hidden layer, (w,)."""
    m, w = network.n_factors, out.shape[0]
    weights = layer(network, theta, network.offsets.shape[0] - 1)[0][component]
    copy_into(weights[:w], out)
    for j in range(m):
        add_multiple(out, phi[phi.shape[0] - m + j], weights[(1 + j) * w : (2 + j) * w])


@compiled
def output_inputs_along(
    network: Network, hidden: Vector, hidden_dot: Vector, phi: Vector, phi_dot: Vector
) -> Vector:
    """Return the derivative of :func:`output_inputs_at` along a direction."""
    m, w = network.n_factors, hidden.shape[0]
    if m == 0:
        return hidden_dot
    first = phi.shape[0] - m
    out = np.empty((1 + m) * w + m)
    copy_into(hidden_dot, out[:w])
    for j in range(m):
        u, u_dot = phi[first + j], phi_dot[first + j]
        out[(1 + m) * w + j] = u_dot
        for i in range(w):
            out[(1 + j) * w + i] = hidden_dot[i] * u + hidden[i] * u_dot
    return out


@compiled
def features_at(network: Network, x: Vector, out: Vector) -> None:
    """Write the features of a point."""
    for i in range(out.shape[0]):
        out[i] = _feature(network, i, x[network.feature_indices[i]])


@compiled
def write_features(network: Network, points: Matrix, features: Matrix) -> None:
    """Write the features of points, (N, ·), one point to a column, (p, N)."""
    for j in range(features.shape[0]):
        index, row = network.feature_indices[j], features[j]
        for n in range(points.shape[0]):
            row[n] = _feature(network, j, points[n, index])


@compiled
def _feature(network: Network, i: int, value: float) -> float:
    """Return feature i, given the component of the point that it is made of."""
    kind = network.feature_kinds[i]
    if kind == FeatureKind.COS:
        value = math.cos(value)
    elif kind == FeatureKind.SIN:
        value = math.sin(value)
    scaled: float = value / network.feature_scales[i]
    return scaled


@compiled
def layer(network: Network, theta: Real, index: int) -> tuple[Real, Real]:
    """Return views of the weights, (outputs, inputs), and biases of a layer."""
    n_in, n_out = network.layer_inputs[index], network.sizes[index + 1]
    start = network.offsets[index]
    middle = start + n_in * n_out
    return theta[start:middle].reshape(n_out, n_in), theta[middle : middle + n_out]


@compiled
def _activate(values: Real) -> None:
    for i in range(values.shape[0]):
        row = values[i]
        for n in range(row.shape[0]):
            row[n] = tanh(row[n])


@compiled
def units_by_points(buffer: Real, units: int, n: int) -> Real:
    """Return the start of a flat buffer as a matrix, (units, n)."""
    return buffer[: units * n].reshape(units, n)


@compiled
def forward(network: Network, theta: Real, inputs: Real, hidden: Real, outputs: Real) -> None:
    """Evaluate the network at n points, one to a column so that each unit's row is contiguous.

    ``inputs`` (p, n), ``hidden`` (L, at least w n) of flat buffers, ``outputs`` (r, n); the last
    two are written.
    """
    n, depth, width = inputs.shape[1], network.offsets.shape[0] - 1, network.sizes[1]
    values = inputs
    for index in range(depth):
        W, b = layer(network, theta, index)
        above = units_by_points(hidden[index], width, n)
        multiply_and_shift(W, values, b, above)
        _activate(above)
        values = above
    W, b = layer(network, theta, depth)
    multiply_and_shift(W, output_inputs(network, values, inputs), b, outputs)


@compiled
def mean_forward(
    network: Network, thetas: Real, inputs: Real, hidden: Real, outputs: Real, one: Real
) -> None:
    """Evaluate the mean of networks with parameters (E, q) as :func:`forward` does one.

    ``one`` (r, n) is scratch memory.
    """
    forward(network, thetas[0], inputs, hidden, outputs)
    if thetas.shape[0] == 1:
        return
    for k in range(1, thetas.shape[0]):
        forward(network, thetas[k], inputs, hidden, one)
        for i in range(outputs.shape[0]):
            for n in range(outputs.shape[1]):
                outputs[i, n] += one[i, n]
    for i in range(outputs.shape[0]):
        for n in range(outputs.shape[1]):
            outputs[i, n] /= thetas.shape[0]


@compiled
def through_tanh(delta: Matrix, activations: Matrix) -> None:
    """Multiply δ, (w, n), by the derivative of tanh, given the activations, (w, n)."""
    for i in range(delta.shape[0]):
        _through_tanh(delta[i], activations[i])


@compiled
def loss_gradient(
    network: Network,
    theta: Vector,
    inputs: Matrix,
    targets: Matrix,
    hidden: Matrix,
    deltas: Matrix,
    gradient: Vector,
) -> None:
    """Write the gradient of mean_n ‖a_θ(x_n) - y_n‖² over a batch, (q,).

    ``inputs`` (p, n), ``targets`` (r, n); ``hidden`` (L, ·) and ``deltas`` (3, ·) are flat scratch
    buffers of at least max(w, r) n entries each.
    """
    n, depth, width = inputs.shape[1], network.offsets.shape[0] - 1, network.sizes[1]
    errors = units_by_points(deltas[2], targets.shape[0], n)
    forward(network, theta, inputs, hidden, errors)
    for k in range(errors.shape[0]):
        for i in range(n):
            errors[k, i] = 2.0 / n * (errors[k, i] - targets[k, i])
    delta, ones = errors, np.ones((1, n))
    for index in range(depth, -1, -1):
        dW, db = layer(network, gradient, index)
        inner_products(delta, ones, db.reshape(-1, 1))
        if index == 0:
            inner_products(delta, inputs, dW)
        else:
            W, _ = layer(network, theta, index)
            values = units_by_points(hidden[index - 1], width, n)
            below = units_by_points(deltas[index % 2], width, n)
            if index == depth and network.n_factors > 0:
                inner_products(delta, output_inputs(network, values, inputs), dW)
                slopes = np.empty((W.shape[1], n))
                multiply(W.T, delta, slopes)
                sum_over_factors(network.n_factors, slopes, inputs, below)
            else:
                inner_products(delta, values, dW)
                multiply(W.T, delta, below)
            through_tanh(below, values)
            delta = below


@compiled
def activations_at(
    network: Network, theta: Vector, phi: Vector, hidden: Matrix, output: Vector
) -> None:
    """Evaluate the network at one point: ``hidden`` (L, w) and ``output`` (r,) are written."""
    depth = network.offsets.shape[0] - 1
    below = phi
    for index in range(depth):
        W, b = layer(network, theta, index)
        values = hidden[index]
        multiply_vector(W, below, values)
        for i in range(values.shape[0]):
            values[i] = tanh(values[i] + b[i])
        below = values
    W, b = layer(network, theta, depth)
    multiply_vector(W, output_inputs_at(network, below, phi), output)
    for k in range(b.shape[0]):
        output[k] += b[k]


@compiled
def multiply_vector(W: Matrix, x: Vector, out: Vector) -> None:
    """Write W x, (n,), for the first entries of x."""
    inner_products(W, x.reshape(1, -1), out.reshape(-1, 1))


@compiled
def output_signal(
    network: Network, theta: Vector, phi: Vector, hidden: Matrix, component: int, delta: Vector
) -> None:
    """Write δ, (w,), of the last hidden layer: the derivative of output k."""
    output_slopes(network, theta, phi, component, delta)
    _through_tanh(delta, hidden[hidden.shape[0] - 1])


@compiled
def _through_tanh(delta: Vector, h: Vector) -> None:
    for i in range(delta.shape[0]):
        delta[i] *= 1.0 - squared(h[i])


@compiled
def back_signals(
    network: Network, theta: Vector, phi: Vector, hidden: Matrix, signals: Stack
) -> None:
    """Write δ, (r, L, w): the derivative of each output with respect to every pre-activation."""
    depth = network.offsets.shape[0] - 1
    for k in range(signals.shape[0]):
        output_signal(network, theta, phi, hidden, k, signals[k, depth - 1])
    for index in range(depth - 1, 0, -1):
        W, _ = layer(network, theta, index)
        multiply(signals[:, index], W, signals[:, index - 1])
        for k in range(signals.shape[0]):
            _through_tanh(signals[k, index - 1], hidden[index - 1])


@compiled
def batch_back_signals(
    network: Network, theta: Vector, inputs: Matrix, hidden: Matrix, r: int
) -> Stack:
    """Return δ of every output and hidden layer, (r L, w, N), layer by layer of an output.

    ``inputs`` (p, N) are features, ``hidden`` (L, w N) the activations there.
    """
    n, m, p = inputs.shape[1], network.n_factors, inputs.shape[0]
    depth, width = network.offsets.shape[0] - 1, network.sizes[1]
    out = np.empty((r * depth, width, n))
    last, _ = layer(network, theta, depth)
    for k in range(r):
        for index in range(depth - 1, -1, -1):
            h = units_by_points(hidden[index], width, n)
            signal = out[k * depth + index]
            if index == depth - 1:
                for i in range(width):
                    signal[i] = last[k, i]
                    for j in range(m):
                        signal[i] += inputs[p - m + j] * last[k, (1 + j) * width + i]
            else:
                W, _ = layer(network, theta, index + 1)
                multiply(W.T, out[k * depth + index + 1], signal)
            through_tanh(signal, h)
    return out


@compiled
def parameter_gradient(
    network: Network, phi: Vector, hidden: Matrix, deltas: Matrix, component: int, out: Vector
) -> None:
    """Write g = ∂a_k/∂θ, (q,): in each layer δ ⊗ (activations below, 1)."""
    depth = network.offsets.shape[0] - 1
    for index in range(depth):
        below = phi if index == 0 else hidden[index - 1]
        dW, db = layer(network, out, index)
        multiply(deltas[index].reshape(-1, 1), below.reshape(1, -1), dW)
        copy_into(deltas[index], db)
    top = output_inputs_at(network, hidden[depth - 1], phi)
    _write_output_row(network, top, 1.0, component, out)


@compiled
def _write_output_row(
    network: Network, top: Vector, one: float, component: int, out: Vector
) -> None:
    """Write the part of the output layer, (top, one) in the row of output k and zeros elsewhere."""
    dW, db = layer(network, out, network.offsets.shape[0] - 1)
    for k in range(db.shape[0]):
        db[k] = one if k == component else 0.0
        if k != component:
            for j in range(dW.shape[1]):
                dW[k, j] = 0.0
    copy_into(top, dW[component])


@compiled
def features_along(network: Network, x: Vector, direction: Vector, out: Vector) -> None:
    """Write the derivative of the features along a direction of the point."""
    for i in range(out.shape[0]):
        index = network.feature_indices[i]
        kind = network.feature_kinds[i]
        slope = 1.0
        if kind == FeatureKind.COS:
            slope = -math.sin(x[index])
        elif kind == FeatureKind.SIN:
            slope = math.cos(x[index])
        out[i] = slope * direction[index] / network.feature_scales[i]


@compiled
def activations_along(
    network: Network, theta: Vector, phi_dot: Vector, hidden: Matrix, hidden_dot: Matrix
) -> None:
    """Write the derivative of the activations, (L, w), along a direction."""
    below = phi_dot
    for index in range(hidden.shape[0]):
        W, _ = layer(network, theta, index)
        multiply_vector(W, below, hidden_dot[index])
        _through_tanh(hidden_dot[index], hidden[index])
        below = hidden_dot[index]


@compiled
def output_signal_along(
    network: Network,
    theta: Vector,
    phi: Vector,
    phi_dot: Vector,
    hidden: Matrix,
    hidden_dot: Matrix,
    component: int,
    delta_dot: Vector,
) -> None:
    """Write the derivative of δ, (w,), of the last hidden layer along a direction."""
    depth, width, m = network.offsets.shape[0] - 1, hidden.shape[1], network.n_factors
    h, h_dot = hidden[depth - 1], hidden_dot[depth - 1]
    output_slopes(network, theta, phi, component, delta_dot)
    for i in range(width):
        delta_dot[i] *= -2.0 * h[i] * h_dot[i]
    if m == 0:
        return
    weights, slopes = layer(network, theta, depth)[0][component], np.zeros(width)
    for j in range(m):
        u_dot = phi_dot[phi_dot.shape[0] - m + j]
        add_multiple(slopes, u_dot, weights[(1 + j) * width : (2 + j) * width])
    for i in range(width):
        delta_dot[i] += slopes[i] * (1.0 - squared(h[i]))


@compiled
def signals_below(
    network: Network, theta: Vector, hidden: Matrix, hidden_dots: Stack, signals: Stack
) -> None:
    """Write δ and its derivatives along m directions, (1 + m, L, w), given the last layer's."""
    for index in range(hidden.shape[0] - 1, 0, -1):
        W, _ = layer(network, theta, index)
        multiply(signals[:, index], W, signals[:, index - 1])
        back, h = signals[0, index - 1], hidden[index - 1]
        for k in range(hidden_dots.shape[0]):
            delta_dot, hidden_dot = signals[1 + k, index - 1], hidden_dots[k, index - 1]
            _through_tanh(delta_dot, h)
            for j in range(back.shape[0]):
                delta_dot[j] += back[j] * (-2.0 * h[j] * hidden_dot[j])
        _through_tanh(back, h)


@compiled
def gradient_along(
    network: Network,
    phi: Vector,
    phi_dot: Vector,
    hidden: Matrix,
    hidden_dot: Matrix,
    deltas: Matrix,
    deltas_dot: Matrix,
    component: int,
    out: Vector,
) -> None:
    """Write the derivative of g, (q,), along a direction: one column of D B."""
    depth = network.offsets.shape[0] - 1
    for index in range(depth):
        below = phi if index == 0 else hidden[index - 1]
        below_dot = phi_dot if index == 0 else hidden_dot[index - 1]
        dW, db = layer(network, out, index)
        multiply(deltas_dot[index].reshape(-1, 1), below.reshape(1, -1), dW)
        add_product(deltas[index].reshape(-1, 1), below_dot.reshape(1, -1), dW)
        copy_into(deltas_dot[index], db)
    top_dot = output_inputs_along(network, hidden[depth - 1], hidden_dot[depth - 1], phi, phi_dot)
    _write_output_row(network, top_dot, 0.0, component, out)
