"""Simulation of windows of a log in compiled code, with forward sensitivities.

The derivative of the state is f(x, v) = known(x, v; c) + E A N(φ(x)), with v what acts of the
inputs, c the constants, N a network of one layer of tanh units, and A the sizes of its outputs. An
input that is recorded at time T acts from T + D on, held until the next one; an actuator of first
order follows it, dv/dt = (u - v)/τ, which is integrated exactly. The state is integrated by the
method of Runge and Kutta of fourth order, from one switch of the input to the next, and with it
its derivatives by the parameters and the initial state. They are derivatives of the method itself:
a step makes S to F S + Σ W ∂f/∂p, over its four stages.

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

DERIVATIVES = types.void(*[types.float64[::1]] * 4, types.float64[:, ::1])

DIGEST = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]
"""Of this file, on which the machine code depends."""


def _inlined(function: CompiledFunction) -> CompiledFunction:
    """Compile a function into its callers: a call would hand over each array of the structures."""
    if PLAIN:
        return function
    return numba.njit(error_model="numpy", fastmath=False, inline="always")(function)


def _compiled(function: CompiledFunction) -> CompiledFunction:
    """Compile a function without allocations, so without counts of references of arrays.

    They take most of the time of a simulation: each use of an array of a structure counts.
    """
    if PLAIN:
        return function
    options = {"error_model": "numpy", "fastmath": False, "nogil": True}
    dispatcher = numba.njit(_nrt=False, **options)(function)
    dispatcher._cache = StoredCode(function, f"fitting-{DIGEST}")
    return dispatcher


TOGETHER = 1e-6
"""Part of a sample within which a switch of the input and a sample are at the same time."""

DEPENDENT = 1e-9
"""Size of a column of X, by what it was before the others were taken out, that counts as 0."""


class Structure(NamedTuple):
    """Equations that are simulated, apart from the values of their parameters."""

    known: CompiledFunction  # (x, v, c, f)
    derivatives: CompiledFunction  # (x, v, c, f, G), with G of Work
    driven: Integers  # rows of the state derivative that parameters or inputs change
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
    limits: Vector  # (d,) largest magnitude of each state


class Values(NamedTuple):
    """Values of the parameters."""

    constants: Vector  # c
    slopes: Vector  # (n,) derivatives of the unknown constants by their parameters
    weights: Vector  # network: W₁ᵀ (p, w), b₁ (w), W₂ (r, w), b₂ (r)
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
    """Arrays of one simulation; the first index of A, P and W is a stage of a step."""

    x: Vector
    xs: Vector  # at a stage
    f: Vector
    sum_f: Vector
    other: Vector
    now: Vector  # (m,) what acts of the input
    dnow: Matrix  # (m, 2) its derivatives by delay and lag
    v: Vector  # the same at a stage
    dv: Matrix
    G: Matrix  # (d, d + m + n) derivatives of the known part by x, v and the unknown constants
    A: types.Array  # (4, d, d) ∂f/∂x
    P: types.Array  # (4, d, q) ∂f/∂p
    W: types.Array  # (4, d, d) ∂(state after the step)/∂(f at a stage)
    F: Matrix  # (d, d) ∂(state after the step)/∂(state before it)
    S: Matrix  # (d, q + d)
    moved: Matrix  # S after a step
    phi: Vector
    dphi: Vector
    hidden: Vector
    slopes: Vector  # (w,) derivatives of an output by the arguments of the units


def work_for(d: int, m: int, columns: int, unknown: int, p: int, w: int) -> Work:
    """Return arrays of one simulation.

    S has q + d columns, d for the initial state alone, or 0 without sensitivities.
    """
    vectors = [np.zeros(d) for _ in range(5)]
    of_inputs = [np.zeros(size) for size in (m, (m, 2), m, (m, 2), (d, d + m + unknown))]
    of_stages = [np.zeros((4, d, n)) for n in (d, max(columns - d, 0), d)]
    of_steps = (np.zeros((d, d)), np.zeros((d, columns)), np.zeros((d, columns)))
    of_network = (np.zeros(p), np.zeros(p), np.zeros(w), np.zeros(w))
    return Work._make([*vectors, *of_inputs, *of_stages, *of_steps, *of_network])


class Problem(NamedTuple):
    """Data, model and inputs of the simulation of windows, and room for one window."""

    structure: Structure
    values: Values
    data: Data
    filtered: Matrix  # (N, m) what acts of the inputs
    dfiltered: types.Array  # (N, m, 2) its derivatives by delay and lag
    tolerance: float  # [s] within which a switch of the input and a sample are at the same time
    work: Work
    states: Matrix  # (rows, d) of the last window
    slopes: types.Array  # (rows, d, q + d) S at each row; none where they are not wanted


class Projected(NamedTuple):
    """Linearised windows, from which what their initial states explain is taken out; 0 at first."""

    Q: Matrix  # (rows n, d) of the last window
    R: Matrix  # (rows n, q) of all windows, one below the other, (I - Q Qᵀ) R
    e: Vector  # (rows n,) (I - Q Qᵀ) e
    T: types.Array  # (k, d, d)
    C: types.Array  # (k, d, q) Qᵀ R
    g: Matrix  # (k, d) Qᵀ e


@_compiled
def _dot(a: Vector, b: Vector) -> float:
    """Return the sum of products, of as many as b has: four sums, so that none waits for one."""
    n = b.shape[0]
    s0 = s1 = s2 = s3 = 0.0
    for i in range(0, n - 3, 4):
        s0 += a[i] * b[i]
        s1 += a[i + 1] * b[i + 1]
        s2 += a[i + 2] * b[i + 2]
        s3 += a[i + 3] * b[i + 3]
    for i in range(n - n % 4, n):
        s0 += a[i] * b[i]
    return (s0 + s1) + (s2 + s3)


@_inlined
def _network(structure: Structure, values: Values, work: Work, stage: int, sensitive: bool) -> None:
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
        h[j] = theta[biases + j]
    for i in range(p):
        of_feature = theta[i * w : (i + 1) * w]
        for j in range(w):
            h[j] += of_feature[j] * phi[i]
    for j in range(w):  # apart, so that several are done at once
        h[j] = tanh(h[j])
    for k in range(r):
        row, size, outer = structure.learned[k], values.sizes[k], theta[second + k * w : last]
        work.f[row] += size * (theta[last + k] + _dot(outer, h))
        if not sensitive:
            continue
        slopes = work.slopes
        for j in range(w):
            slopes[j] = size * outer[j] * (1.0 - h[j] * h[j])
        for i in range(p):
            along = _dot(theta[i * w : (i + 1) * w], slopes) * dphi[i]
            work.A[stage, row, structure.feature_indices[i]] += along
        if work.P.shape[2] == 0:
            continue
        out = work.P[stage, row, structure.unknown.shape[0] :]
        out[last + k] = size
        by_bias, by_outer = out[biases:], out[second + k * w :]
        for j in range(w):
            by_bias[j] = slopes[j]
            by_outer[j] = size * h[j]
        for i in range(p):
            by_inner = out[i * w : (i + 1) * w]
            for j in range(w):
                by_inner[j] = slopes[j] * phi[i]


@_inlined
def _rates(structure: Structure, values: Values, work: Work, stage: int, sensitive: bool) -> None:
    """Write f at the state ``xs`` under v, and where wanted A and P."""
    d, m, q = work.xs.shape[0], work.v.shape[0], work.P.shape[2]
    if sensitive:
        G, first = work.G, q - int(structure.free_delay) - int(structure.free_lag)
        structure.derivatives(work.xs, work.v, values.constants, work.f, G)
        for i in range(d):
            for j in range(d):
                work.A[stage, i, j] = G[i, j]
            if q == 0:
                continue
            out = work.P[stage, i]
            for j in range(structure.unknown.shape[0]):
                out[j] = G[i, d + m + j] * values.slopes[j]
            by_delay = by_lag = 0.0
            for j in range(m):
                by_delay += G[i, d + j] * work.dv[j, 0]
                by_lag += G[i, d + j] * work.dv[j, 1]
            if structure.free_delay:
                out[first] = by_delay * values.delay_slope
            if structure.free_lag:
                out[q - 1] = by_lag * values.lag_slope
    else:
        structure.known(work.xs, work.v, values.constants, work.f)
    if structure.width > 0:
        _network(structure, values, work, stage, sensitive)


@_inlined
def _copy(of: Matrix, into: Matrix) -> None:
    for i in range(of.shape[0]):
        for c in range(of.shape[1]):
            into[i, c] = of[i, c]


@_inlined
def _advance(structure: Structure, work: Work, h: float) -> None:
    """Move S by a step: S becomes F S + Σ W P over the stages."""
    d, q = work.xs.shape[0], work.P.shape[2]
    A, P, W, F = work.A, work.P, work.W, work.F
    for stage in range(3, -1, -1):
        weight = h / 3.0 if 0 < stage < 3 else h / 6.0
        share = h if stage == 2 else 0.5 * h
        for i in range(d):
            for j in range(d):
                total = 0.0
                if stage < 3:
                    for k in range(d):
                        total += W[stage + 1, i, k] * A[stage + 1, k, j]
                W[stage, i, j] = share * total + (weight if i == j else 0.0)
    for i in range(d):
        for j in range(d):
            F[i, j] = 1.0 if i == j else 0.0
            for stage in range(4):
                for k in range(d):
                    F[i, j] += W[stage, i, k] * A[stage, k, j]
    for i in range(d):
        out, S, factor = work.moved[i], work.S[i], F[i, i]
        for c in range(out.shape[0]):
            out[c] = factor * S[c]
        for j in range(d):
            S, factor = work.S[j], F[i, j]
            if j != i and factor != 0.0:
                for c in range(out.shape[0]):
                    out[c] += factor * S[c]
        for k in structure.driven:
            P0, P1, P2, P3 = P[0, k], P[1, k], P[2, k], P[3, k]
            w0, w1, w2, w3 = W[0, i, k], W[1, i, k], W[2, i, k], W[3, i, k]
            for c in range(q):
                out[c] += w0 * P0[c] + w1 * P1[c] + w2 * P2[c] + w3 * P3[c]
    _copy(work.moved, work.S)


@_inlined
def _held(
    values: Values, u: Vector, v: Vector, dv: Matrix, s: float, at: Vector, dat: Matrix
) -> None:
    """Write v and its derivatives by delay and lag, (m, 2), s seconds later under u held.

    They may be written in their own places.
    """
    if values.lag <= 0.0:
        for j in range(u.shape[0]):
            at[j] = u[j]
            dat[j, 0] = dat[j, 1] = 0.0
        return
    left = math.exp(-s / values.lag)
    for j in range(u.shape[0]):
        dat[j, 0] = left * dv[j, 0]
        dat[j, 1] = left * dv[j, 1] + (v[j] - u[j]) * left * s / (values.lag * values.lag)
        at[j] = u[j] + (v[j] - u[j]) * left


@_inlined
def _integrate(
    structure: Structure, values: Values, work: Work, u: Vector, seconds: float, sensitive: bool
) -> None:
    """Move x and S, and what acts of u with its derivatives, by a time during which u is held."""
    d = work.x.shape[0]
    steps = max(1, math.ceil(seconds / structure.longest_step - 1e-9))
    h = seconds / steps
    for step in range(steps):
        for stage in range(4):
            share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            weight = 1.0 / 3.0 if 0 < stage < 3 else 1.0 / 6.0
            _held(values, u, work.now, work.dnow, (step + share) * h, work.v, work.dv)
            for i in range(d):
                work.xs[i] = work.x[i] + share * h * (work.f[i] if stage else 0.0)
            _rates(structure, values, work, stage, sensitive)
            for i in range(d):
                work.sum_f[i] = weight * work.f[i] + (work.sum_f[i] if stage else 0.0)
        for i in range(d):
            work.x[i] += h * work.sum_f[i]
        if sensitive:
            _advance(structure, work, h)
    _held(values, u, work.now, work.dnow, seconds, work.now, work.dnow)


@_inlined
def _switched(
    structure: Structure, values: Values, work: Work, before: Vector, after: Vector, sensitive: bool
) -> None:
    """Take in that the input has switched: the derivatives by the delay change."""
    if not structure.free_delay:
        return
    if values.lag > 0.0:
        for j in range(before.shape[0]):
            work.dnow[j, 0] += (before[j] - after[j]) / values.lag
        return
    d, n = work.S.shape
    if not sensitive or n == d:
        return
    column = n - d - 1 - int(structure.free_lag)
    for i in range(d):
        work.xs[i] = work.x[i]
    for j in range(before.shape[0]):
        work.v[j] = before[j]
    _rates(structure, values, work, 0, False)
    for i in range(d):
        work.other[i] = work.f[i]
    for j in range(before.shape[0]):
        work.v[j] = after[j]
    _rates(structure, values, work, 0, False)
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
def filter_inputs(
    data: Data, values: Values, tolerance: float, work: Work, v: Matrix, dv: types.Array
) -> None:
    """Write v, (N, m), and its derivatives by delay and lag, (N, m, 2), at every row."""
    m, now, dnow, j = data.inputs.shape[1], work.now, work.dnow, 0
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
                    _held(values, data.inputs[j], now, dnow, to - t, now, dnow)
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
def run(problem: Problem, first: int, last: int, start: Vector) -> bool:
    """Simulate rows ``first`` to ``last`` from a state; tell whether all stayed within the limit.

    Written are the states, and S at each row where it is wanted.
    """
    structure, values, data, work = problem.structure, problem.values, problem.data, problem.work
    states, slopes, sensitive = problem.states, problem.slopes, problem.slopes.shape[0] > 0
    d, n = work.S.shape
    m = data.inputs.shape[1]
    for i in range(m):
        work.now[i] = problem.filtered[first, i]
        for j in range(2):
            work.dnow[i, j] = problem.dfiltered[first, i, j]
    for i in range(d):
        work.x[i] = start[i]
        states[0, i] = start[i]
    if sensitive:
        work.S[:] = 0.0
        for i in range(d):
            work.S[i, n - d + i] = 1.0
        _copy(work.S, slopes[0])
    j = acting_input(data, first, values.delay, problem.tolerance)
    for row in range(first, last):
        t, end = data.time[row], data.time[row + 1]
        while True:
            switch = data.time[j + 1] + values.delay if j < data.lasts[row] else np.inf
            if switch > end + problem.tolerance:
                switch = np.inf
            to = min(switch, end)
            if to > t:
                _integrate(structure, values, work, data.inputs[j], to - t, sensitive)
                t = to
            if switch == np.inf:
                break
            _switched(structure, values, work, data.inputs[j], data.inputs[j + 1], sensitive)
            j += 1
        for i in range(d):
            if not abs(work.x[i]) <= structure.limits[i]:
                return False
            states[row + 1 - first, i] = work.x[i]
        if sensitive:
            _copy(work.S, slopes[row + 1 - first])
    return True


@_compiled
def write_window(problem: Problem, first: int, last: int, weight: float, into: Projected) -> None:
    """Write one window that was simulated, times its weight; ``into`` has its part alone."""
    data, states, slopes = problem.data, problem.states, problem.slopes
    Q, R, e, T, C, g = into.Q, into.R, into.e, into.T, into.C, into.g
    n, d, q, at = data.measured.shape[1], states.shape[1], R.shape[1], 0
    for k in range(last - first + 1):
        for c in range(n):
            state, size = problem.structure.measured[c], 1.0 / data.deviations[c]
            seen = data.measured[first + k, c]
            if math.isnan(seen):
                Q[at, :] = 0.0
            else:
                for i in range(q):
                    R[at, i] = slopes[k, state, i] * size * weight
                for i in range(d):
                    Q[at, i] = slopes[k, state, q + i] * size * weight
                e[at] = (seen - states[k, state]) * size * weight
            at += 1
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
    for i in range(d):
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


@_compiled
def squares_of(problem: Problem, first: int, last: int) -> float:
    """Return ‖e‖² of a window that was simulated."""
    data, total = problem.data, 0.0
    for k in range(last - first + 1):
        for c in range(data.measured.shape[1]):
            seen = data.measured[first + k, c]
            if not math.isnan(seen):
                state = problem.structure.measured[c]
                error = (seen - problem.states[k, state]) / data.deviations[c]
                total += error * error
    return total


@_compiled
def simulate(
    problem: Problem,
    windows: types.Array,
    starts: Matrix,
    weights: Vector,
    into: Projected,
    squares: Vector,
) -> None:
    """Simulate windows, (k, 2) first and last rows, from their initial states, (k, d).

    Where slopes are wanted and R has rows, the windows are linearised, and 0 is left where one
    leaves the limit. Otherwise ``squares``, (k,), are ‖e‖², inf where one does.

    All that simulates is compiled in this one function.
    """
    n, at = problem.data.measured.shape[1], 0
    for k in range(windows.shape[0]):
        first, last = windows[k, 0], windows[k, 1]
        inside = run(problem, first, last, starts[k])
        if into.R.shape[0] == 0:
            squares[k] = squares_of(problem, first, last) if inside else np.inf
            continue
        end = at + (last - first + 1) * n
        if inside:
            own = Projected(into.Q, into.R[at:end], into.e[at:end], into.T[k], into.C[k], into.g[k])
            write_window(problem, first, last, weights[k], own)
        at = end
