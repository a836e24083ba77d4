"""Checks of a custom system: its names, its numbers, its equations and their size."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dopt.errors import ScaleWarning, SpecificationError, suggestion
from dopt.learning import Learner
from dopt.models import MLP, Model
from dopt.models.linear import linear_terms
from dopt.policies import Policy
from dopt.systems.base import KINDS, Array, System
from dopt.systems.black_box import BlackBox
from dopt.systems.properties import input_effect

LARGEST = 100.0
"""Root mean square of the accelerations over the grid up to which a network learns them well.

In the shipped systems it is 2 to 60 in their units.
"""

SMALLEST = 0.05

WEAKEST = 0.1
"""λ below which a filter over state and parameters does not learn."""


@functools.lru_cache(maxsize=64)
def warn_of_scale(system: System, model: Model) -> None:
    """Warn where the accelerations are of another size than the outputs of a network.

    Weights begin at about 1 and move by the learning rate at each step, in whatever unit the
    accelerations are: in one in which they are in thousands, most of the error is left at the end.
    """
    if isinstance(system, BlackBox) or not isinstance(model, MLP):
        return
    values = system.learned(system.grid())
    warn_of_sizes(system, np.sqrt(np.mean(values**2, axis=0)), "over the evaluation grid")


@functools.lru_cache(maxsize=64)
def warn_of_prior(policy: Policy, model: Model, learner: Learner) -> None:
    """Warn where a filter over state and parameters begins with weights that may be anything.

    Its prediction is then as uncertain from the first step on, and its linearisation wrong.
    """
    regularization = getattr(policy, "regularization", None)
    if not (learner.estimates_states and isinstance(model, MLP)) or regularization is None:
        return
    if regularization < WEAKEST:
        warnings.warn(
            f"policy.regularization is {regularization:g}, which gives each initial parameter the "
            f"variance {1 / regularization:.3g}, but learner '{learner.name}' needs one of about "
            f"1/3: set policy.regularization to 3.",
            ScaleWarning,
            stacklevel=2,
        )


def warn_of_sizes(
    system: System, sizes: Array, where: str, first: str = "", units: Array | None = None
) -> int:
    """Warn of each learned acceleration whose size, (r,), a network does not learn well.

    Returns how many there are.

    ``first`` is advice that goes before that on its unit. With ``units``, (r,), sizes are multiples
    of these, which the box of a plant decides about.
    """
    found = 0
    remedy = "measure that state in a unit"
    if units is not None:
        remedy = "declare a half-width of the box of that state"
    for k, (row, size) in enumerate(zip(system.learned_rows, sizes, strict=True)):
        if size > LARGEST or 0 < size < SMALLEST:
            found += 1
            unit = 1.0 if units is None else units[k]
            warnings.warn(
                f"The learned acceleration of {system.state_labels[row]} in env '{system.name}' "
                f"has a root mean square of {size * unit:.3g} {where}, but a network learns one of "
                f"{SMALLEST * unit:g} to {LARGEST * unit:g} well: {first}{remedy} about "
                f"{size:.1g} times as large.",
                ScaleWarning,
                stacklevel=2,
            )
    return found


FACTORS = (0.5, 1.0, 2.0)
"""Multiples of the linear parameters at which the accelerations have to be affine in them."""

AFFINE = 1e-6
"""Largest departure from an affine function, relative to the largest of its terms."""


def check_names(system: System) -> None:
    """Refuse names of parameters that the system does not have.

    Raises
    ------
    SpecificationError
        If ``physical`` names no attribute, or ``linear_parameters`` none of ``physical``.
    """
    as_named = type(system).parameters is System.parameters
    for name in system.physical:
        if as_named and not hasattr(system, name):
            raise SpecificationError(
                f"physical of env '{system.name}' names '{name}', but {type(system).__name__} has "
                f"no attribute of that name: declare it as a field, {name}: float = "
                f"parameter(...), or correct the name."
            )
    for name in system.linear_parameters:
        if name not in system.physical:
            remedy = "it has none, so leave it out."
            if system.physical:
                remedy = suggestion(name, system.physical)
            raise SpecificationError(
                f"linear_parameters of env '{system.name}' names '{name}', but names of its "
                f"physical parameters are expected: {remedy}"
            )


def check_linear(system: System, points: Array) -> None:
    """Refuse parameters in which the accelerations are not affine, at points, (n, d).

    The oracle takes them as offset + Psi theta (:attr:`System.linear_form`).

    Raises
    ------
    SpecificationError
        If they are another function of these parameters, or not finite where one is 0 or 1.
    """
    names = system.linear_parameters
    if not names:
        return
    try:
        with np.errstate(all="ignore"):
            affine = all(_is_affine(system, points, factor) for factor in FACTORS)
    except ArithmeticError:
        affine = False
    if not affine:
        raise SpecificationError(
            f"linear_parameters of env '{system.name}' are {', '.join(names)}, but its "
            f"accelerations are not affine in them, offset + Psi theta: name only parameters in "
            f"which they are."
        )


def _is_affine(system: System, points: Array, factor: float) -> bool:
    """Return whether the linear form gives the accelerations at a multiple of the parameters."""
    values = dict(zip(system.physical, system.parameters, strict=True))
    theta = factor * np.array([values[name] or 1.0 for name in system.linear_parameters])
    values |= zip(system.linear_parameters, theta.tolist(), strict=True)
    offset, psi = linear_terms(system, points)
    rows = system.accelerations(tuple(points.T), tuple(values.values()))
    found = np.stack(np.broadcast_arrays(*rows, points[:, 0])[:-1], axis=-1)
    apart = np.abs(found - offset - psi @ theta).max()
    largest = max(np.abs(offset).max(), np.abs(psi * theta).max())
    return bool(apart <= AFFINE * (1.0 + largest))


def check_finite(system: System) -> None:
    """Refuse equations that are not finite at the initial state or on the evaluation grid.

    Raises
    ------
    SpecificationError
        If an acceleration is not at one of these states, or the known part at the first one.
    """
    start, grid = np.array([system.initial_state]), system.grid()
    with np.errstate(all="ignore"):
        flow = system.known_flow(start, np.zeros((1, system.n_inputs)))
        first, rest = system.learned(start), system.learned(grid)
    learned = tuple(system.state_labels[row] for row in system.learned_rows)
    for what, values, labels, states in (
        ("known", flow, system.state_labels, start),
        ("accelerations", first, learned, start),
        ("accelerations", rest, learned, grid),
    ):
        place, field = INITIAL if states is start else GRID
        for i, k in np.argwhere(~np.isfinite(values))[:1]:
            named = zip(system.state_labels, states[i], strict=True)
            raise SpecificationError(
                f"{what}() of env '{system.name}' gives {values[i, k]} for the derivative of "
                f"{labels[k]} at {place}, {', '.join(f'{one} = {x:.4g}' for one, x in named)}, but "
                f"a finite number is expected: correct the equation, or {field}."
            )


INITIAL = "the initial state", "env.initial_state"
GRID = "a state of the evaluation grid", "env.grid_half_widths"
"""State at which an equation has to be finite, and the field that moves it."""

STATES = 5
"""States at once at which the equations are tried."""

STEP = 1e-30
"""Imaginary step, from which the derivative is exact to rounding."""

DIFFERENCES = (1e-4, 1e-6)
"""Steps of the central differences; one of them has to agree with the complex step."""

AGREEMENT = 1e-3
"""Largest departure of a derivative, relative to the largest of its equation."""

_SEED = 20_240_601


@functools.lru_cache(maxsize=1024)
def check_system(system: System) -> None:
    """Try a system's declarations and equations; try out a black box.

    Raises
    ------
    SpecificationError
        If a declared index is not the index of a state, or the equations fail, return something
        else than was declared, are not finite where a trial begins or is evaluated, depend on the
        inputs or the linear parameters in another way than an affine one, or have a wrong
        derivative by a complex step; if a black box says so.
    """
    check_names(system)
    _check_indices(system)
    if isinstance(system, BlackBox) and system.measured:
        return  # nothing may run on it
    if isinstance(system, BlackBox):
        system.try_out()
        return
    rng = np.random.default_rng(_SEED)
    states = rng.uniform(-1, 1, (system.n_states, STATES))
    inputs = rng.uniform(-1, 1, (system.n_inputs, STATES))
    points = np.concatenate([states, inputs]) if system.reads_inputs else states
    _try(system, "accelerations", system.n_learned, tuple(points))
    _try(system, "known", system.n_states, tuple(states), tuple(inputs))
    check_finite(system)
    check_linear(system, points.T)
    if not input_effect(system).is_affine:
        raise SpecificationError(
            f"known() of env '{system.name}' is not affine in the inputs, but a derivative of the "
            f"form f(x) + B(x) u is expected: make the input another quantity, in which it is."
        )
    if system.compiled:
        for point in points.T:
            _check_derivatives(system, point)


def _check_derivatives(system: System, point: Array) -> None:
    """Compare the derivatives of the accelerations by a complex step with differences."""
    exact = _moved(system, point.astype(complex), 1j * STEP).imag / STEP
    sides = ((_moved(system, point, step), _moved(system, point, -step)) for step in DIFFERENCES)
    differences = np.array(
        [(ahead - behind) / (2 * h) for h, (ahead, behind) in zip(DIFFERENCES, sides, strict=True)]
    )
    apart = np.abs(exact - differences).min(axis=0)
    wrong = np.argwhere(apart > AGREEMENT * (1.0 + np.abs(exact).max()))
    if len(wrong):
        j, k = wrong[0]
        labels = (*system.state_labels, *system.input_labels)
        raise SpecificationError(
            f"accelerations() of env '{system.name}' has in entry {k} the derivative "
            f"{exact[j, k]:.4g} along {labels[j]} by a complex step, but "
            f"{differences[-1, j, k]:.4g} by differences: use sign, where and magnitude of "
            f"dopt.systems.elementary in place of other functions of that kind, such as numpy.sign "
            f"and abs, or declare compiled = False in the class."
        )


def _moved(system: System, point: Any, step: complex) -> Any:
    """Return the accelerations, (d, r), with each component of a point moved by a step in turn."""
    moved = point + step * np.eye(len(point))
    try:
        with np.errstate(all="ignore"):
            return np.array([system.accelerations(tuple(x), system.parameters) for x in moved])
    except Exception as error:
        kind = "complex numbers" if np.iscomplexobj(moved) else "numbers"
        raise SpecificationError(
            f"accelerations() of env '{system.name}' fails for {kind} "
            f"({type(error).__name__}: {error}), by which its derivatives are taken: write it with "
            f"the functions of dopt.systems.elementary, or declare compiled = False in the class."
        ) from error


def _check_indices(system: System) -> None:
    d, name = system.n_states, system.name
    for feature in system.features:
        if getattr(feature, "kind", None) not in KINDS:
            raise SpecificationError(
                f"features of env '{name}' hold {feature!r}, but entries like Feature('cos', 0) of "
                f"the kinds {', '.join(KINDS)} are expected: make it one of these."
            )
    declared = {
        "learned_rows": system.learned_rows,
        "grid_indices": system.grid_indices,
        "angle_indices": system.angle_indices,
        "phase_plane": system.phase_plane,
        "features": tuple(feature.index for feature in system.features),
    }
    for what, indices in declared.items():
        for index in indices:
            if not 0 <= index < d:
                raise SpecificationError(
                    f"{what} of env '{name}' holds {index}, but its {d} states have the numbers 0 "
                    f"to {d - 1}: correct it."
                )
    if len(set(system.learned_rows)) < len(system.learned_rows):
        raise SpecificationError(
            f"learned_rows of env '{name}' are {system.learned_rows}, but no row twice is "
            f"expected: name each learned row of the state derivative once."
        )


def _try(system: System, what: str, size: int, *arguments: Sequence[Any]) -> None:
    """Refuse an equation that does not give so many numbers for many states at once."""
    equation: Callable[..., Any] = getattr(system, what)
    entry = "state" if what == "known" else "learned row"
    try:
        with np.errstate(all="ignore"):
            values = equation(*arguments, system.parameters)
        single = _is_single(values, size)
        entries = () if single else values
        found = np.array([np.broadcast_to(value, (STATES,)) for value in entries], dtype=float)
    except Exception as error:
        raise SpecificationError(
            f"{what}() of env '{system.name}' fails for arrays of {STATES} states "
            f"({type(error).__name__}: {error}), but sums, products and the functions of "
            f"dopt.systems.elementary are expected in it, which serve numbers, arrays and tensors "
            f"alike: write it with these."
        ) from error
    if single or len(found) != size:
        returned = "one number" if single else f"{len(found)} numbers"
        raise SpecificationError(
            f"{what}() of env '{system.name}' returns {returned}, but a tuple of {size} is "
            f"expected, one for each {entry}: correct it; a tuple of one is written with its comma."
        )


def _is_single(values: Any, size: int) -> bool:
    """Return whether an equation gives one number, or one for each state, in place of a tuple."""
    if isinstance(values, np.ndarray) and values.ndim:
        return values.shape == (STATES,) and size != STATES
    return isinstance(values, int | float | np.generic | np.ndarray)
