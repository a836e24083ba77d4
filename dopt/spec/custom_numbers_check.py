"""Check of the numbers of a custom system: its parameters, and its equations where a trial asks."""

from __future__ import annotations

import numpy as np

from dopt.errors import SpecificationError, suggestion
from dopt.systems.base import Array, System

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
            raise SpecificationError(
                f"linear_parameters of env '{system.name}' names '{name}', but names of its "
                f"physical parameters are expected: {_choice(name, system.physical)}"
            )


def _choice(name: str, physical: tuple[str, ...]) -> str:
    return suggestion(name, physical) if physical else "it has none, so leave it out."


def check_linear(system: System, points: Array) -> None:
    """Refuse parameters in which the accelerations are not affine, at points, (d, n).

    The oracle takes them as offset + Psi theta (:attr:`System.linear_form`).

    Raises
    ------
    SpecificationError
        If they are another function of these parameters, or not finite where one is 0 or 1.
    """
    names = system.linear_parameters
    if not names:
        return
    with np.errstate(all="ignore"):
        affine = all(_is_affine(system, points, factor) for factor in FACTORS)
    if not affine:
        raise SpecificationError(
            f"linear_parameters of env '{system.name}' are {', '.join(names)}, but its "
            f"accelerations are not affine in them, offset + Psi theta: name only parameters in "
            f"which they are."
        )


def _is_affine(system: System, points: Array, factor: float) -> bool:
    """Return whether the linear form gives the accelerations at a multiple of the parameters."""
    names = system.linear_parameters
    values = dict(zip(system.physical, system.parameters, strict=True))
    theta = factor * np.array([values[name] or 1.0 for name in names])
    offset, *ones = (_at(system, points, parameters) for parameters in system.linear_form)
    terms = np.array([offset, *(theta[:, None, None] * (np.array(ones) - offset))])
    moved = values | dict(zip(names, theta.tolist(), strict=True))
    found = _at(system, points, tuple(moved[name] for name in system.physical))
    apart = np.abs(found - terms.sum(axis=0)).max()
    return bool(apart <= AFFINE * (1.0 + np.abs(terms).max()))


def _at(system: System, points: Array, parameters: tuple[float, ...]) -> Array:
    """Return the accelerations, (r, n); NaN where they cannot be computed."""
    shape = (system.n_learned, points.shape[1])
    try:
        values = system.accelerations(tuple(points), parameters)
        return np.array([np.broadcast_to(value, shape[1:]) for value in values], dtype=float)
    except ArithmeticError:
        return np.full(shape, np.nan)


def check_finite(system: System) -> None:
    """Refuse equations that are not finite at the initial state or on the evaluation grid.

    Raises
    ------
    SpecificationError
        If an acceleration is not at one of these states, or the known part at the first one.
    """
    start, rest = np.array([system.initial_state]), np.zeros(system.n_inputs)
    with np.errstate(all="ignore"):
        flow = system.known(tuple(start[0]), tuple(rest), system.parameters)
        first, grid = system.learned(start), system.learned(system.grid())
    learned = [system.state_labels[row] for row in system.learned_rows]
    _refuse(system, "known", np.array([flow], float), start, system.state_labels, INITIAL)
    _refuse(system, "accelerations", first, start, learned, INITIAL)
    _refuse(system, "accelerations", grid, system.grid(), learned, GRID)


INITIAL = "the initial state", "env.initial_state"
GRID = "a state of the evaluation grid", "env.grid_half_widths"
"""State at which an equation has to be finite, and the field that moves it."""


def _refuse(
    system: System,
    what: str,
    values: Array,
    states: Array,
    labels: tuple[str, ...] | list[str],
    where: tuple[str, str],
) -> None:
    """Refuse values, (N, k), of an equation at states, (N, d), that are not finite."""
    wrong = np.argwhere(~np.isfinite(values))
    if not len(wrong):
        return
    i, k = wrong[0]
    state = ", ".join(
        f"{label} = {x:.4g}" for label, x in zip(system.state_labels, states[i], strict=True)
    )
    place, field = where
    raise SpecificationError(
        f"{what}() of env '{system.name}' gives {values[i, k]} for the derivative of {labels[k]} "
        f"at {place}, {state}, but a finite number is expected: correct the equation, or {field}."
    )
