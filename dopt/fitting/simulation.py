"""Simulation of windows of a log in compiled code, with forward sensitivities.

The derivative of the state is f(x, v) = known(x, v; c) + E A N(φ(x)), with v what acts of the
inputs, c the constants, N a network of one layer of tanh units, and A the sizes of its outputs. An
input that is recorded at time T acts from T + D on, held until the next one; an actuator of first
order follows it, dv/dt = (u - v)/τ, which is integrated exactly. The state is integrated by the
method of Runge and Kutta of fourth order, from one switch of the input to the next, and with it
its derivatives by the parameters and the initial state:

======  ======================================================================  =========
symbol  meaning                                                                 shape
======  ======================================================================  =========
p       parameters: unknown constants, network, delay D, lag τ                  q
S       ∂x/∂(p, x₀), d/dt S = ∂f/∂x S + ∂f/∂v ∂v/∂p + ∂f/∂p                     d × (q + d)
e       measured less simulated, each divided by its standard deviation         rows
R, X    ∂(C x)/∂p and ∂(C x)/∂x₀, divided likewise                              rows × q, d
======  ======================================================================  =========

Where a switch of the input comes later by dD, the state moves by (f before - f after) dD. The
initial state of every window is free: with X = Q T, Q orthonormal, its best change for a change δ
of the parameters is T⁻¹ Qᵀ(e - R δ), and what is left of the problem has the rows (I - Q Qᵀ) R and
(I - Q Qᵀ) e.

References: H. Bock, "Numerical treatment of inverse problems in chemical reaction kinetics" (1981),
for multiple shooting; G. Golub and V. Pereyra, "Separable nonlinear least squares" (2003), for the
elimination.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
from numba import types

from dopt.kernel.compiler import StoredCode
from dopt.kernel.network import tanh
from dopt.kernel.plain import PLAIN
from dopt.types import CompiledFunction, Integers, Matrix, Vector

COMPLEX_KNOWN = types.void(*[types.complex128[::1]] * 4)

_DIGEST = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]


def _inlined(function: CompiledFunction) -> CompiledFunction:
    """Compile a function into its callers: a call would count references of all arrays."""
    if PLAIN:
        return function
    return numba.njit(error_model="numpy", fastmath=False, inline="always")(function)


def _compiled(function: CompiledFunction) -> CompiledFunction:
    if PLAIN:
        return function
    dispatcher = numba.njit(error_model="numpy", fastmath=False, nogil=True)(function)
    dispatcher._cache = StoredCode(function, f"fitting-{_DIGEST}")
    return dispatcher


STEP = 1e-30
"""Imaginary part of a complex step."""

TOGETHER = 1e-6
"""Part of a sample within which a switch of the input and a sample are at the same time."""

DEPENDENT = 1e-9
"""Size of a column of X, by what it was before the others were taken out, that counts as 0."""


class Structure(NamedTuple):
    """What is simulated, apart from the values of its parameters."""

    known: CompiledFunction  # (x, v, c, out)
    complex_known: CompiledFunction
    unknown: Integers  # (n,) places of the unknown constants in c
    learned: Integers  # (r,) rows of the state derivative with an output of the network
    feature_kinds: Integers  # (p,) 0: the state itself, 1: its cosine, 2: its sine
    feature_indices: Integers  # (p,)
    feature_centers: Vector  # (p,)
    feature_scales: Vector  # (p,)
    measured: Integers  # (n,) states that are measured
    width: int  # w units of the network, 0 without one
    free_delay: bool
    free_lag: bool
    longest_step: float  # [s]
    limit: float  # largest magnitude of a state


class Values(NamedTuple):
    """Values of the parameters."""

    constants: Vector  # c
    slopes: Vector  # (n,) derivatives of the unknown constants by their parameters
    weights: Vector  # network: W₁ (w, p), b₁ (w), W₂ (r, w), b₂ (r)
    sizes: Vector  # (r,) A
    delay: float  # D [s]
    lag: float  # τ [s]
    delay_slope: float  # derivative of D by its parameter
    lag_slope: float


class Data(NamedTuple):
    """Rows of all logs, piece after piece."""

    time: Vector  # (N,)
    measured: Matrix  # (N, n), NaN where nothing was measured
    inputs: Matrix  # (N, m)
    firsts: Integers  # (N,) first row of the piece of each row
    lasts: Integers  # (N,) last row of it
    deviations: Vector  # (n,) standard deviation of what is measured


class Work(NamedTuple):
    """Arrays of one simulation."""

    x: Vector
    xs: Vector  # at a stage
    f: Vector
    sum_f: Vector
    other: Vector
    v: Vector  # what acts of the input at a stage
    A: Matrix  # (d, d) ∂f/∂x
    B: Matrix  # (d, m) ∂f/∂v
    P: Matrix  # (d, q + d) ∂f/∂p
    S: Matrix  # (d, q + d)
    Ss: Matrix
    K: Matrix
    sums: Matrix
    zx: types.Array
    zv: types.Array
    zc: types.Array
    zf: types.Array
    phi: Vector
    dphi: Vector
    hidden: Vector


def work_for(d: int, m: int, columns: int, c: int, p: int, w: int) -> Work:
    """Return arrays of one simulation.

    S has q + d columns, d for the initial state alone, or 0 without sensitivities.
    """
    n = columns
    vectors = [np.zeros(d) for _ in range(5)]
    matrices = [np.zeros((d, n)) for _ in range(5)]
    complexes = [np.zeros(size, np.complex128) for size in (d, m, c, d)]
    of_inputs = (np.zeros(m), np.zeros((d, d)), np.zeros((d, m)))
    of_network = (np.zeros(p), np.zeros(p), np.zeros(w))
    return Work._make([*vectors, *of_inputs, *matrices, *complexes, *of_network])


@_inlined
def _network(structure: Structure, values: Values, work: Work, sensitive: bool) -> None:
    """Add the network to f, and where wanted its derivatives to A and P."""
    w, p = structure.width, structure.feature_kinds.shape[0]
    r, theta = structure.learned.shape[0], values.weights
    phi, dphi, h = work.phi, work.dphi, work.hidden
    for i in range(p):
        x = work.xs[structure.feature_indices[i]]
        kind = structure.feature_kinds[i]
        if kind == 1:
            phi[i], dphi[i] = math.cos(x), -math.sin(x)
        elif kind == 2:
            phi[i], dphi[i] = math.sin(x), math.cos(x)
        else:
            scale = structure.feature_scales[i]
            phi[i], dphi[i] = (x - structure.feature_centers[i]) / scale, 1.0 / scale
    biases, second, last = w * p, w * p + w, w * p + w + r * w
    for j in range(w):
        total = theta[biases + j]
        for i in range(p):
            total += theta[j * p + i] * phi[i]
        h[j] = tanh(total)
    first = structure.unknown.shape[0]
    for k in range(r):
        row, size = structure.learned[k], values.sizes[k]
        total = theta[last + k]
        for j in range(w):
            total += theta[second + k * w + j] * h[j]
        work.f[row] += size * total
        if not sensitive:
            continue
        out = work.P[row]
        of_all = out.shape[0] > work.xs.shape[0]
        if of_all:
            out[first + last + k] = size
        for j in range(w):
            slope = size * theta[second + k * w + j] * (1.0 - h[j] * h[j])
            for i in range(p):
                work.A[row, structure.feature_indices[i]] += slope * theta[j * p + i] * dphi[i]
            if of_all:
                out[first + second + k * w + j] = size * h[j]
                out[first + biases + j] = slope
                for i in range(p):
                    out[first + j * p + i] = slope * phi[i]


@_inlined
def _rates(structure: Structure, values: Values, work: Work, sensitive: bool) -> None:
    """Write f at the state ``xs`` under v, and where wanted A, B and P."""
    d, m = work.xs.shape[0], work.v.shape[0]
    structure.known(work.xs, work.v, values.constants, work.f)
    if sensitive:
        for i in range(d):
            work.zx[i] = work.xs[i]
        for i in range(m):
            work.zv[i] = work.v[i]
        for i in range(values.constants.shape[0]):
            work.zc[i] = values.constants[i]
        for j in range(d):
            work.zx[j] += 1j * STEP
            structure.complex_known(work.zx, work.zv, work.zc, work.zf)
            work.zx[j] = work.xs[j]
            for i in range(d):
                work.A[i, j] = work.zf[i].imag / STEP
        for j in range(m):
            work.zv[j] += 1j * STEP
            structure.complex_known(work.zx, work.zv, work.zc, work.zf)
            work.zv[j] = work.v[j]
            for i in range(d):
                work.B[i, j] = work.zf[i].imag / STEP
        for j in range(structure.unknown.shape[0] if work.P.shape[1] > d else 0):
            at = structure.unknown[j]
            work.zc[at] += 1j * STEP
            structure.complex_known(work.zx, work.zv, work.zc, work.zf)
            work.zc[at] = values.constants[at]
            for i in range(d):
                work.P[i, j] = work.zf[i].imag / STEP * values.slopes[j]
    if structure.width > 0:
        _network(structure, values, work, sensitive)


@_inlined
def _combine(work: Work, through_lag: Matrix, first: int, n_times: int) -> None:
    """Write K = A S + P, with what the delay and the lag change of v added."""
    d, n = work.S.shape
    for i in range(d):
        K, P = work.K[i], work.P[i]
        for c in range(n):
            K[c] = P[c]
        for j in range(d):
            a = work.A[i, j]
            if a != 0.0:
                S = work.Ss[j]
                for c in range(n):
                    K[c] += a * S[c]
        for c in range(n_times):
            for j in range(work.B.shape[1]):
                K[first + c] += work.B[i, j] * through_lag[j, c]


@_inlined
def _held(
    values: Values, u: Vector, v: Vector, dv: Matrix, s: float, at: Vector, dat: Matrix
) -> None:
    """Write v and its derivatives by delay and lag, (m, 2), s seconds later under u held."""
    if values.lag <= 0.0:
        for j in range(u.shape[0]):
            at[j] = u[j]
            dat[j, 0] = dat[j, 1] = 0.0
        return
    left = math.exp(-s / values.lag)
    for j in range(u.shape[0]):
        at[j] = u[j] + (v[j] - u[j]) * left
        dat[j, 0] = left * dv[j, 0]
        dat[j, 1] = left * dv[j, 1] + (v[j] - u[j]) * left * s / (values.lag * values.lag)


@_inlined
def _integrate(
    structure: Structure,
    values: Values,
    work: Work,
    u: Vector,
    v: Vector,
    dv: Matrix,
    seconds: float,
    sensitive: bool,
) -> None:
    """Move x and S, and v with its derivatives, by a time during which u is held."""
    d, n = work.S.shape
    m = u.shape[0]
    steps = max(1, math.ceil(seconds / structure.longest_step - 1e-9))
    h = seconds / steps
    q = n - d
    n_times = int(structure.free_delay) + int(structure.free_lag) if q > 0 else 0
    first = q - n_times
    dat, picked = np.zeros((m, 2)), np.zeros((m, 2))
    for step in range(steps):
        for stage in range(4):
            share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            weight = 1.0 / 3.0 if 0 < stage < 3 else 1.0 / 6.0
            _held(values, u, v, dv, (step + share) * h, work.v, dat)
            for i in range(d):
                work.xs[i] = work.x[i] + share * h * (work.f[i] if stage else 0.0)
            if sensitive:
                for i in range(d):
                    S, Ss, K = work.S[i], work.Ss[i], work.K[i]
                    if stage == 0:
                        for c in range(n):
                            Ss[c] = S[c]
                    else:
                        for c in range(n):
                            Ss[c] = S[c] + share * h * K[c]
            _rates(structure, values, work, sensitive)
            if sensitive:
                for j in range(m):
                    c = 0
                    if structure.free_delay:
                        picked[j, c] = dat[j, 0] * values.delay_slope
                        c += 1
                    if structure.free_lag:
                        picked[j, c] = dat[j, 1] * values.lag_slope
                _combine(work, picked, first, n_times)
            for i in range(d):
                work.sum_f[i] = weight * work.f[i] + (work.sum_f[i] if stage else 0.0)
                if sensitive:
                    K, total = work.K[i], work.sums[i]
                    if stage == 0:
                        for c in range(n):
                            total[c] = weight * K[c]
                    else:
                        for c in range(n):
                            total[c] += weight * K[c]
        for i in range(d):
            work.x[i] += h * work.sum_f[i]
            if sensitive:
                S, total = work.S[i], work.sums[i]
                for c in range(n):
                    S[c] += h * total[c]
    _held(values, u, v, dv, seconds, work.v, dat)
    for j in range(m):
        v[j] = work.v[j]
        dv[j, 0], dv[j, 1] = dat[j, 0], dat[j, 1]


@_inlined
def _switched(
    structure: Structure,
    values: Values,
    work: Work,
    before: Vector,
    after: Vector,
    dv: Matrix,
    sensitive: bool,
) -> None:
    """Take in that the input has switched: the derivatives by the delay change."""
    if not structure.free_delay:
        return
    if values.lag > 0.0:
        for j in range(before.shape[0]):
            dv[j, 0] += (before[j] - after[j]) / values.lag
        return
    d, n = work.S.shape
    if not sensitive or n == d:
        return
    column = n - d - 1 - int(structure.free_lag)
    for i in range(d):
        work.xs[i] = work.x[i]
    for j in range(before.shape[0]):
        work.v[j] = before[j]
    _rates(structure, values, work, False)
    for i in range(d):
        work.other[i] = work.f[i]
    for j in range(before.shape[0]):
        work.v[j] = after[j]
    _rates(structure, values, work, False)
    for i in range(d):
        work.S[i, column] += (work.other[i] - work.f[i]) * values.delay_slope


@_compiled
def acting_input(data: Data, row: int, delay: float, tolerance: float) -> int:
    """Return the row whose input acts at a row's time: the newest not after it less the delay."""
    at, first, last = data.time[row] - delay + tolerance, data.firsts[row], data.lasts[row]
    low, high = first, last
    while low < high:
        middle = (low + high + 1) // 2
        if data.time[middle] <= at:
            low = middle
        else:
            high = middle - 1
    return int(low)


@_compiled
def filter_inputs(data: Data, values: Values, tolerance: float, v: Matrix, dv: types.Array) -> None:
    """Write v, (N, m), and its derivatives by delay and lag, (N, m, 2), at every row."""
    m = data.inputs.shape[1]
    at, dat, now, dnow = np.zeros(m), np.zeros((m, 2)), np.zeros(m), np.zeros((m, 2))
    j = 0
    for row in range(data.time.shape[0]):
        if row == data.firsts[row]:
            j = acting_input(data, row, values.delay, tolerance)
            for i in range(m):
                now[i] = data.inputs[j, i]
                dnow[i, 0] = dnow[i, 1] = 0.0
        else:
            t, end = data.time[row - 1], data.time[row]
            while True:
                switch = data.time[j + 1] + values.delay if j < data.lasts[row] else np.inf
                if switch > end + tolerance:
                    switch = np.inf
                to = min(switch, end)
                if to > t:
                    _held(values, data.inputs[j], now, dnow, to - t, at, dat)
                    for i in range(m):
                        now[i] = at[i]
                        dnow[i, 0], dnow[i, 1] = dat[i, 0], dat[i, 1]
                    t = to
                if switch == np.inf:
                    break
                if values.lag > 0.0:
                    for i in range(m):
                        dnow[i, 0] += (data.inputs[j, i] - data.inputs[j + 1, i]) / values.lag
                j += 1
        for i in range(m):
            v[row, i] = now[i]
            dv[row, i, 0], dv[row, i, 1] = dnow[i, 0], dnow[i, 1]


@_compiled
def run(
    structure: Structure,
    values: Values,
    data: Data,
    first: int,
    last: int,
    start: Vector,
    filtered: Matrix,
    dfiltered: types.Array,
    tolerance: float,
    work: Work,
    sensitive: bool,
    states: Matrix,
    slopes: types.Array,
) -> bool:
    """Simulate rows ``first`` to ``last`` from a state; tell whether all stayed within the limit.

    Written are the states, (rows, d), and S at each row, (rows, d, q + d), where wanted.
    """
    d, n = work.S.shape
    m = data.inputs.shape[1]
    v, dv = np.zeros(m), np.zeros((m, 2))
    for i in range(m):
        v[i] = filtered[first, i]
        dv[i, 0], dv[i, 1] = dfiltered[first, i, 0], dfiltered[first, i, 1]
    for i in range(d):
        work.x[i] = start[i]
        states[0, i] = start[i]
    if sensitive:
        work.S[:] = 0.0
        work.P[:] = 0.0
        for i in range(d):
            work.S[i, n - d + i] = 1.0
        slopes[0] = work.S
    j = acting_input(data, first, values.delay, tolerance)
    for row in range(first, last):
        t, end = data.time[row], data.time[row + 1]
        while True:
            switch = data.time[j + 1] + values.delay if j < data.lasts[row] else np.inf
            if switch > end + tolerance:
                switch = np.inf
            to = min(switch, end)
            if to > t:
                _integrate(structure, values, work, data.inputs[j], v, dv, to - t, sensitive)
                t = to
            if switch == np.inf:
                break
            _switched(structure, values, work, data.inputs[j], data.inputs[j + 1], dv, sensitive)
            j += 1
        for i in range(d):
            if not abs(work.x[i]) <= structure.limit:
                return False
            states[row + 1 - first, i] = work.x[i]
        if sensitive:
            slopes[row + 1 - first] = work.S
    return True


@_compiled
def write_window(
    structure: Structure,
    data: Data,
    first: int,
    rows: int,
    q: int,
    weight: float,
    states: Matrix,
    slopes: types.Array,
    R: Matrix,
    e: Vector,
    Q: Matrix,
    T: Matrix,
    C: Matrix,
    g: Vector,
) -> float:
    """Write the rows (I - Q Qᵀ) R and (I - Q Qᵀ) e of one window, times its weight.

    Also written are T, C = Qᵀ R and g = Qᵀ e; ‖e‖² without the weight is returned.
    """
    n, d = structure.measured.shape[0], states.shape[1]
    total, at = 0.0, 0
    for k in range(rows):
        for c in range(n):
            state, size = structure.measured[c], 1.0 / data.deviations[c]
            seen = data.measured[first + k, c]
            if math.isnan(seen):
                R[at, :] = 0.0
                Q[at, :] = 0.0
                e[at] = 0.0
            else:
                for i in range(q):
                    R[at, i] = slopes[k, state, i] * size * weight
                for i in range(d):
                    Q[at, i] = slopes[k, state, q + i] * size * weight
                error = (seen - states[k, state]) * size
                total += error * error
                e[at] = error * weight
            at += 1
    T[:] = 0.0
    for i in range(d):
        before = 0.0
        for a in range(at):
            before += Q[a, i] * Q[a, i]
        for _ in range(2):
            for j in range(i):
                inner = 0.0
                for a in range(at):
                    inner += Q[a, j] * Q[a, i]
                T[j, i] += inner
                for a in range(at):
                    Q[a, i] -= inner * Q[a, j]
        after = 0.0
        for a in range(at):
            after += Q[a, i] * Q[a, i]
        if after <= DEPENDENT * DEPENDENT * before or after == 0.0:
            Q[:at, i] = 0.0
            continue
        T[i, i] = math.sqrt(after)
        for a in range(at):
            Q[a, i] /= T[i, i]
    C[:] = 0.0
    for i in range(d):
        g[i] = 0.0
        for a in range(at):
            share = Q[a, i]
            g[i] += share * e[a]
            for c in range(q):
                C[i, c] += share * R[a, c]
        for a in range(at):
            share = Q[a, i]
            e[a] -= share * g[i]
            for c in range(q):
                R[a, c] -= share * C[i, c]
    return total


@_compiled
def write_rows(
    structure: Structure,
    values: Values,
    data: Data,
    windows: types.Array,
    starts: Matrix,
    weights: Vector,
    filtered: Matrix,
    dfiltered: types.Array,
    tolerance: float,
    work: Work,
    R: Matrix,
    e: Vector,
    T: types.Array,
    C: types.Array,
    g: Matrix,
    squares: Vector,
) -> None:
    """Write the rows of windows, (k, 2) first and last rows, one below the other.

    ``squares`` are ‖e‖² of the windows with their initial states, (k, d), as they are; inf where a
    window leaves the limit, whose rows are 0.
    """
    d, n = work.S.shape
    q, channels = n - d, structure.measured.shape[0]
    longest = 0
    for k in range(windows.shape[0]):
        longest = max(longest, windows[k, 1] - windows[k, 0] + 1)
    states, slopes = np.empty((longest, d)), np.empty((longest, d, n))
    Q, at = np.empty((longest * channels, d)), 0
    for k in range(windows.shape[0]):
        first, rows = windows[k, 0], windows[k, 1] - windows[k, 0] + 1
        here = slice(at, at + rows * channels)
        inside = run(
            structure,
            values,
            data,
            first,
            windows[k, 1],
            starts[k],
            filtered,
            dfiltered,
            tolerance,
            work,
            True,
            states,
            slopes,
        )
        if inside:
            squares[k] = write_window(
                structure,
                data,
                first,
                rows,
                q,
                weights[k],
                states,
                slopes,
                R[here],
                e[here],
                Q,
                T[k],
                C[k],
                g[k],
            )
        else:
            squares[k] = np.inf
            R[here] = 0.0
            e[here] = 0.0
            T[k] = 0.0
            C[k] = 0.0
            g[k] = 0.0
        at += rows * channels


@_compiled
def write_squares(
    structure: Structure,
    values: Values,
    data: Data,
    windows: types.Array,
    starts: Matrix,
    filtered: Matrix,
    dfiltered: types.Array,
    tolerance: float,
    work: Work,
    squares: Vector,
) -> None:
    """Write ‖e‖² of windows, without sensitivities; inf where one leaves the limit."""
    d, channels = work.x.shape[0], structure.measured.shape[0]
    longest = 0
    for k in range(windows.shape[0]):
        longest = max(longest, windows[k, 1] - windows[k, 0] + 1)
    states, nothing = np.empty((longest, d)), np.empty((0, d, 0))
    for k in range(windows.shape[0]):
        first, last = windows[k, 0], windows[k, 1]
        inside = run(
            structure,
            values,
            data,
            first,
            last,
            starts[k],
            filtered,
            dfiltered,
            tolerance,
            work,
            False,
            states,
            nothing,
        )
        squares[k] = 0.0 if inside else np.inf
        if not inside:
            continue
        for row in range(last - first + 1):
            for c in range(channels):
                seen = data.measured[first + row, c]
                if not math.isnan(seen):
                    error = (seen - states[row, structure.measured[c]]) / data.deviations[c]
                    squares[k] += error * error
