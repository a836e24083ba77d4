"""The simulated model of a plant: its parameters, their values, and derivatives of its equations.

Each expression of the known part is taken apart into operations, equal ones once, and each is
differentiated by the chain rule. At a corner (:mod:`dopt.systems.elementary`) the derivative is the
one along increasing arguments. The derivative of a power is 0 at the base 0, and by its exponent at
bases below 0, too.
"""

from __future__ import annotations

import ast
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from scipy.interpolate import make_interp_spline

from dopt.errors import SpecificationError
from dopt.fitting.simulation import DERIVATIVES, Data, Structure, Values, Work, work_for
from dopt.kernel.equations import KNOWN
from dopt.kernel.plain import PLAIN
from dopt.log import Log, Piece
from dopt.systems.expressions import FUNCTIONS
from dopt.systems.plant import Encoder, Plant, Unknown, first_guess
from dopt.types import Array, Booleans, CompiledFunction, Equation, Integers, NumbaType

_SYMBOLS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}

Slopes = dict[str, str]
"""Derivatives that are not always 0, by the quantity."""


def differentiated_text(
    texts: Sequence[str], arguments: Mapping[str, Sequence[str]], by: Sequence[str]
) -> tuple[Equation, Booleans]:
    """Return a function that writes values and derivatives, and which of these may differ from 0.

    Parameters
    ----------
    texts : sequence of str
        n expressions, which :func:`dopt.systems.expressions.compiled_text` has accepted.
    arguments : mapping of str to sequence of str
        Arguments of the function, each an array of named quantities. Two more are written: (n,)
        values and (n, k) derivatives, except where they are always 0.
    by : sequence of str
        k quantities; for none of them there are no derivatives to write.

    Returns
    -------
    function, where : function and (n, k)
    """
    chain = _Chain(by)
    rows = [chain.of(ast.parse(text.strip(), mode="eval").body) for text in texts]
    given = [f"_{argument}" for argument in arguments]  # no quantity begins with an underscore
    lines = [
        f"{name} = {group}[{i}]"
        for group, names in zip(given, arguments.values(), strict=True)
        for i, name in enumerate(names)
    ]
    lines += [f"{name} = {text}" for text, name in chain.names.items()]
    for i, (value, slopes) in enumerate(rows):
        lines.append(f"_values[{i}] = {value}")
        lines += [f"_slopes[{i}, {by.index(name)}] = {slope}" for name, slope in slopes.items()]
    given += ["_values", "_slopes"] if by else ["_values"]
    source = "\n    ".join([f"def equation({', '.join(given)}):", *lines])
    namespace: dict[str, Any] = {**FUNCTIONS, "log": math.log, "__name__": "derivatives"}
    exec(source, namespace)  # of nothing but expressions that were checked
    return namespace["equation"], np.array([[name in slopes for name in by] for _, slopes in rows])


class _Chain:
    """Operations, each with a name, and their derivatives."""

    def __init__(self, by: Sequence[str]) -> None:
        self.by = by
        self.names: dict[str, str] = {}

    def of(self, node: ast.expr) -> tuple[str, Slopes]:
        """Return the name of a value, and its derivatives."""
        match node:
            case ast.Constant(value=value):
                return self._named(repr(float(value))), {}  # type: ignore[arg-type]  # checked
            case ast.Name(id=name):
                return name, {name: "1.0"} if name in self.by else {}
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                x, dx = self.of(operand)
                return self._named(f"-{x}"), self._sum(("-1.0", dx))
            case ast.UnaryOp(operand=operand):
                return self.of(operand)
            case ast.BinOp(left=left, op=operator, right=right):
                return self._operation(type(operator), self.of(left), self.of(right), right)
            case ast.Call(func=ast.Name(id="where"), args=[condition, *either]):
                return self._either(condition, *map(self.of, either))
            case ast.Call(func=ast.Name(id=function), args=[argument]):
                return self._function(function, *self.of(argument))
        raise TypeError(ast.unparse(node))

    def _operation(
        self,
        kind: type[ast.operator],
        left: tuple[str, Slopes],
        right: tuple[str, Slopes],
        power: ast.expr,
    ) -> tuple[str, Slopes]:
        (a, da), (b, db) = left, right
        out = self._named(f"{a} {_SYMBOLS[kind]} {b}")
        if kind is ast.Add:
            return out, self._sum(("1.0", da), ("1.0", db))
        if kind is ast.Sub:
            return out, self._sum(("1.0", da), ("-1.0", db))
        if kind is ast.Mult:
            return out, self._sum((b, da), (a, db))
        if kind is ast.Div:
            return out, self._sum((f"1.0 / {b}", da), (f"-{out} / {b}", db))
        match power:
            case ast.Constant(value=0 | 1 | 2 as k):
                return out, self._sum((f"{k}.0 * {a}" if k == 2 else "1.0", da if k else {}))
        base = self._named(f"where({a} > 0.0, {a}, 1.0)")
        other = self._named(f"where({a} == 0.0, 1.0, {a})")
        return out, self._sum((f"{b} * {out} / {other}", da), (f"{out} * log({base})", db))

    def _function(self, name: str, x: str, dx: Slopes) -> tuple[str, Slopes]:
        out = self._named(f"{name}({x})")
        slope = {
            "sin": f"cos({x})",
            "cos": f"-sin({x})",
            "tanh": f"1.0 - {out} * {out}",
            "magnitude": f"where({x} >= 0.0, 1.0, -1.0)",
            "sign": "",
        }[name]
        return out, self._sum((slope, dx if slope else {}))

    def _either(
        self, condition: ast.expr, first: tuple[str, Slopes], second: tuple[str, Slopes]
    ) -> tuple[str, Slopes]:
        assert isinstance(condition, ast.Compare)
        (x, _), (y, _) = self.of(condition.left), self.of(condition.comparators[0])
        sign = ast.unparse(ast.Compare(ast.Name(x), condition.ops, [ast.Name(y)]))
        (a, da), (b, db) = first, second
        return self._named(f"where({sign}, {a}, {b})"), {
            name: self._named(f"where({sign}, {da.get(name, '0.0')}, {db.get(name, '0.0')})")
            for name in {**da, **db}
        }

    def _sum(self, *terms: tuple[str, Slopes]) -> Slopes:
        """Return the sums of derivatives times factors."""
        sums: Slopes = {}
        for factor, slopes in terms:
            for name, slope in slopes.items():
                if factor == "1.0":
                    term = slope
                else:
                    term = self._named(factor)
                    term = term if slope == "1.0" else self._named(f"{term} * {slope}")
                sums[name] = self._named(f"{sums[name]} + {term}") if name in sums else term
        return sums

    def _named(self, text: str) -> str:
        return text if text.isidentifier() else self.names.setdefault(text, f"_{len(self.names)}")


_KINDS = {"identity": 0, "cos": 1, "sin": 2}

HOLDS = {"zero": 0, "linear": 1, "cubic": 3}
"""Degrees of the curve through the rows of an input."""

PARTS = 4
"""Parts of a sample over which an interpolated input is taken as constant."""

MOST_STEPS = 300.0
"""Steps of a plant in one of a log, or of a log in one of a plant, beyond which a unit is wrong."""


class Known(NamedTuple):
    """The known part of a plant, compiled."""

    values: CompiledFunction  # (x, v, c, f)
    derivatives: CompiledFunction  # (x, v, c, f, G), with G of Work
    driven: Integers  # rows that constants or inputs change


Names = tuple[str, ...]


@functools.lru_cache(maxsize=64)
def compiled_known(
    texts: Names, states: Names, inputs: Names, constants: Names, unknown: Names
) -> Known:
    """Compile the known part of a plant, and its derivatives."""
    groups = {"states": states, "inputs": inputs, "constants": constants}
    values, _ = differentiated_text(texts, groups, [])
    derivatives, where = differentiated_text(texts, groups, [*states, *inputs, *unknown])
    driven = np.flatnonzero(where[:, len(states) :].any(axis=1))

    def compiled(function: CompiledFunction, signature: NumbaType) -> CompiledFunction:
        if PLAIN:
            return function
        code = numba.njit(error_model="numpy", fastmath=False)(function)
        code.compile(signature.args)
        code.disable_compile()
        return code

    return Known(compiled(values, KNOWN), compiled(derivatives, DERIVATIVES), driven)


def unknown_of(plant: Plant) -> dict[str, Unknown]:
    """Return the unknown constants of a plant."""
    return {k: v for k, v in plant.constants.items() if isinstance(v, Unknown)}


class Layout(NamedTuple):
    """Scales of the inputs and outputs of a network: seen ranges of a fit without one."""

    centers: Array  # (p,)
    scales: Array  # (p,)
    sizes: Array  # (r,)


class Model:
    """A plant as it is simulated.

    The parameters p are the unknown constants, the weights of the network, and where they are
    unknown the delay and the lag, each in standard deviations of its prior. A ``delay`` that is
    given is known.

    Attributes
    ----------
    prior : (q,)
        Centre of the prior, at which a fit begins.
    names : tuple of str
        The n parameters that have a name, which come first, and delay and lag, which come last.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        width: int = 0,
        layout: Layout | None = None,
        delay: float | None = None,
        seed: int = 0,
        longest_step: float | None = None,
    ) -> None:
        self.plant, self.width = plant, width
        self.delay = first_guess(plant.delay) if delay is None else delay
        options: dict[str, Any] = {"delay": delay, "longest_step": longest_step, "seed": seed}
        self._made = functools.partial(Model, plant, width=width, layout=layout, **options)
        times = {"delay": plant.delay if delay is None else delay, "lag": plant.lag}
        free = [name for name, value in times.items() if isinstance(value, Unknown)]
        system = plant.system(1)
        self.d, self.m = len(plant.states), len(plant.inputs)
        self.equation, self.unknown = system.known, unknown_of(plant)
        names = map(tuple, (plant.states, plant.inputs, plant.constants, self.unknown))
        known = compiled_known(tuple(plant.known.get(n, "0.0") for n in plant.states), *names)
        places = [i for i, name in enumerate(plant.constants) if name in self.unknown]
        features = system.features
        p, r = len(features), len(system.learned_rows)
        layout = layout or Layout(np.zeros(p), np.ones(p), np.ones(r))
        measured = [i for i, name in enumerate(plant.states) if name in measured_names(plant)]
        self.rates = rates_of(plant, measured)
        limits = plant.system(1, scaled=True).state_limits
        limits[list(system.angle_indices)] = np.finfo(float).max  # they turn without bound
        self.structure = Structure(
            known=known.values,
            derivatives=known.derivatives,
            driven=np.union1d(known.driven, system.learned_rows if width else []).astype(np.int64),
            unknown=np.array(places, np.int64),
            learned=np.array(system.learned_rows, np.int64),
            feature_kinds=np.array([_KINDS[f.kind] for f in features], np.int64),
            feature_indices=np.array([f.index for f in features], np.int64),
            feature_centers=layout.centers,
            feature_scales=layout.scales,
            measured=np.array(measured, np.int64),
            width=width,
            free_delay="delay" in free,
            free_lag="lag" in free,
            longest_step=float(longest_step or plant.dt),
            limits=limits,
        )
        self.sizes = layout.sizes
        self._guesses = np.array([*plant.guesses.values()], float)
        n_weights = (p + 1) * width + (width + 1) * r if width else 0
        weights = np.zeros(n_weights)
        rng = np.random.default_rng(seed)
        inner = rng.standard_normal((width, p)).T.ravel(), rng.standard_normal(width)
        weights[: (p + 1) * width] = np.concatenate(inner)  # the output layer begins at zero
        self.n_named, self.n_weights = len(places), n_weights
        self.prior = np.concatenate([np.zeros(len(places)), weights, np.zeros(len(free))])
        self.names = (*self.unknown, *free)
        self._times = {name: len(places) + n_weights + i for i, name in enumerate(free)}
        self.named = [*range(len(places)), *self._times.values()]

    @property
    def q(self) -> int:
        """Number of parameters."""
        return len(self.prior)

    def with_network(self, width: int, layout: Layout, seed: int) -> Model:
        """Return the same model with a network beside the known part."""
        return self._made(width=width, layout=layout, seed=seed)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the model is made of, and not what is compiled for it."""
        return self._made, ()

    def extended(self, p: Array, other: Model) -> Array:
        """Return the parameters of another model without a network in the places of this one."""
        out = self.prior.copy()
        out[: self.n_named] = p[: self.n_named]
        for name, at in self._times.items():
            known = name not in other._times
            out[at] = _deviations(self.plant.delay, other.delay) if known else p[other._times[name]]
        return out

    def values(self, p: Array) -> Values:
        """Return the values of the parameters."""
        constants = self._guesses.copy()
        slopes = np.empty(len(self.unknown))
        for j, (at, unknown) in enumerate(
            zip(self.structure.unknown, self.unknown.values(), strict=True)
        ):
            constants[at] = unknown.at(p[j])
            slopes[j] = unknown.slope(p[j])
        numbers = [float(self.delay), float(first_guess(self.plant.lag)), 0.0, 0.0]
        for i, name in enumerate(("delay", "lag")):
            time = getattr(self.plant, name)
            if name in self._times:
                z = float(p[self._times[name]])
                numbers[i], numbers[2 + i] = float(time.at(z)), float(time.slope(z))
        weights = np.ascontiguousarray(p[self.n_named : self.n_named + self.n_weights])
        sizes = np.ascontiguousarray(self.sizes)
        return Values(constants, slopes, weights, sizes, *numbers)

    def named_values(self, p: Array) -> tuple[dict[str, float], Array]:
        """Return the named parameters, and the derivative of each by its entry of p."""
        values = self.values(p)
        found = {
            name: float(values.constants[at])
            for name, at in zip(self.unknown, self.structure.unknown, strict=True)
        }
        found |= {name: float(getattr(values, name)) for name in self._times}
        times = [getattr(values, f"{name}_slope") for name in self._times]
        return found, np.array([*values.slopes, *times])

    def with_errors(self, p: Array, covariance: Array) -> dict[str, tuple[float, float]]:
        """Return value and standard error of each named parameter, by the covariance of p."""
        values, slopes = self.named_values(p)
        errors = np.abs(slopes) * np.sqrt(np.diag(covariance)[self.named])
        return dict(zip(values, zip(values.values(), errors.tolist(), strict=True), strict=True))

    def derivative(self, p: Array, states: Array, inputs: Array) -> Array:
        """Return dx/dt, (N, d), at states, (N, d), under inputs that act, (N, m)."""
        values = self.values(p)
        rows = self.equation(tuple(states.T), tuple(inputs.T), tuple(values.constants))
        out = np.stack(np.broadcast_arrays(*rows, states[:, 0])[:-1], axis=-1).astype(float)
        if self.width:
            out[:, self.structure.learned] += self.network(values.weights, states)
        return out

    def network(self, weights: Array, states: Array) -> Array:
        """Return the accelerations of the network, (N, r), at states, (N, d)."""
        s, (W1, b1, W2, b2) = self.structure, self.matrices(weights)
        x = states[:, s.feature_indices]
        scaled = (x - s.feature_centers) / s.feature_scales
        phi = np.select(
            [s.feature_kinds == 1, s.feature_kinds == 2], [np.cos(x), np.sin(x)], scaled
        )
        return (np.tanh(phi @ W1.T + b1) @ W2.T + b2) * self.sizes

    def matrices(self, weights: Array) -> tuple[Array, Array, Array, Array]:
        """Return W₁, (w, p), b₁, (w,), W₂, (r, w), and b₂, (r,), of the network."""
        w, p, r = self.width, len(self.structure.feature_kinds), len(self.sizes)
        W1, b1, W2, b2 = np.split(weights, np.cumsum([w * p, w, r * w]))
        return W1.reshape(p, w).T, b1, W2.reshape(r, w), b2 if w else np.zeros(r)

    def work(self, columns: int) -> Work:
        """Return arrays of one simulation, with so many columns of S."""
        sizes = (len(self.unknown), len(self.structure.feature_kinds), self.structure.width)
        return work_for(self.d, self.m, columns, *sizes)


def _deviations(unknown: Any, number: float) -> float:
    """Return by how many standard deviations a number is above the guess."""
    if unknown.factor:
        return math.log(number / unknown.value, unknown.factor)
    return float(number - unknown.value) / float(unknown.spread)


def measured_names(plant: Plant) -> tuple[str, ...]:
    """Return the states that are measured, all where none is named."""
    return tuple(name for name in plant.states if name in plant.measured) or tuple(plant.states)


def rates_of(plant: Plant, measured: Sequence[int]) -> dict[int, tuple[int, float]]:
    """Return of which measured state another one is the rate, and in how many of its units."""
    states = np.random.default_rng(0).uniform(0.5, 1.5, (len(plant.states), 8))
    inputs, system = np.ones((len(plant.inputs), 8)), plant.system(1)
    with np.errstate(all="ignore"):
        flow = system.known(tuple(states), tuple(inputs), system.parameters)
        rates = np.stack(np.broadcast_arrays(*flow, states[0])[:-1])
    found: dict[int, tuple[int, float]] = {}
    for j in range(len(states)):
        for i in measured:
            ratio = rates[i] / states[j]
            if j not in measured and np.ptp(ratio) <= 1e-9 * abs(ratio[0]) and ratio[0] != 0.0:
                found[j] = (i, float(ratio[0]))
    return found


def data_of(plant: Plant, logs: Sequence[Log], hold: str, deviations: Array | None = None) -> Data:
    """Return the pieces of logs one after the other.

    With a linear or cubic hold each sample is divided into parts, in each of which the input is the
    mean of the line or curve through the rows; the rows in between have no measurement.

    Raises
    ------
    SpecificationError
        If a log has other states or inputs than the plant, or steps of another unit.
    """
    if hold not in HOLDS:
        raise SpecificationError(
            f"hold is {hold!r}, but one of {', '.join(HOLDS)} is expected: choose 'zero' for "
            f"inputs that are held between two rows, 'linear' for inputs that were measured, or "
            f"'cubic' for smooth ones."
        )
    wanted = measured_names(plant)
    pieces: list[Piece] = []
    for log in logs:
        missing = [
            name for name in (*wanted, *plant.inputs) if name not in (*log.states, *log.inputs)
        ]
        if missing:
            raise SpecificationError(
                f"a log has the states {', '.join(log.states)} and the inputs "
                f"{', '.join(log.inputs)}, but {missing[0]} of the plant is expected as well: name "
                f"its column, or leave it out of 'measured'."
            )
        columns = [log.states.index(name) for name in wanted]
        given = [log.inputs.index(name) for name in plant.inputs]
        steps = np.concatenate([np.diff(piece.time) for piece in log.pieces])
        step = float(np.median(steps)) if len(steps) else plant.dt
        if not 1.0 / MOST_STEPS <= step / plant.dt <= MOST_STEPS:
            raise SpecificationError(
                f"a log has steps of {step:g} s, but steps of about the plant's dt of "
                f"{plant.dt:g} s are expected: give the unit of its stamps, such as "
                f"units={{'time': 'ms'}}, or correct dt."
            )
        for piece in log.pieces:
            one = Piece(piece.time, piece.measured[:, columns], piece.inputs[:, given])
            pieces.append(_interpolated(one, HOLDS[hold]) if HOLDS[hold] else one)
    pieces = [piece for piece in pieces if len(piece.time) > 1]
    if not pieces:
        raise SpecificationError(
            "the logs have no two rows in a row, but pieces of some hundred rows are expected: "
            "see the notes of the logs."
        )
    sizes = np.array([len(piece.time) for piece in pieces])
    ends = np.cumsum(sizes)
    cut = np.clip(np.concatenate([piece.inputs for piece in pieces]), -plant.supply, plant.supply)
    measured = np.ascontiguousarray(np.concatenate([piece.measured for piece in pieces]))
    return Data(
        np.concatenate([piece.time for piece in pieces]),
        measured,
        np.ascontiguousarray(cut),
        np.repeat(ends - sizes, sizes),
        np.repeat(ends - 1, sizes),
        _first_deviations(plant, measured) if deviations is None else deviations,
    )


def _first_deviations(plant: Plant, measured: Array) -> Array:
    """Return declared standard deviations of the noise, or a thousandth of what was seen."""
    out = []
    for name, column in zip(measured_names(plant), measured.T, strict=True):
        noise = plant.measured.get(name, max(1e-3 * float(np.nanstd(column)), 1e-300))
        out.append(noise.noise if isinstance(noise, Encoder) else float(noise))
    return np.array(out)


def _interpolated(piece: Piece, degree: int) -> Piece:
    t, y, u = piece
    share = np.arange(PARTS) / PARTS
    time = np.concatenate([(t[:-1, None] + np.diff(t)[:, None] * share).ravel(), t[-1:]])
    whole = make_interp_spline(t, u, min(degree, len(t) - 1)).antiderivative()
    means = np.diff(whole(time), axis=0) / np.diff(time)[:, None]
    measured = np.full((len(time), y.shape[1]), np.nan)
    measured[::PARTS] = y
    return Piece(time, measured, np.concatenate([means, u[-1:]]))
