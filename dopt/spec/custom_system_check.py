"""Check of a custom system: its equations are evaluated, differentiated and compiled."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dopt.errors import SpecificationError
from dopt.spec.custom_numbers_check import check_finite, check_linear, check_names
from dopt.systems.base import Array, System
from dopt.systems.black_box import BlackBox
from dopt.systems.features import KINDS, Feature
from dopt.systems.input_effect import input_effect

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
        If a declared index is none of a state's, or the equations fail, return something else than
        was declared, are not finite where a trial begins or is evaluated, depend on the inputs or
        the linear parameters in another way than an affine one, or have a wrong derivative by a
        complex step; if a black box says so.
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
    _tried(system, "accelerations", system.n_learned, tuple(points))
    _tried(system, "known", system.n_states, tuple(states), tuple(inputs))
    check_finite(system)
    check_linear(system, points)
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
        if not isinstance(feature, Feature):
            raise SpecificationError(
                f"features of env '{name}' hold {feature!r}, but entries like "
                f"Feature('cos', 0) are expected: make it a dopt.systems.Feature."
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
    for feature in system.features:
        if feature.kind not in KINDS:
            raise SpecificationError(
                f"features of env '{name}' hold one of kind '{feature.kind}', but the kinds are "
                f"{', '.join(KINDS)}: take one of them."
            )


def _tried(system: System, what: str, size: int, *arguments: Sequence[Any]) -> Array:
    """Return what an equation gives for many states at once, (size, STATES)."""
    equation: Callable[..., Any] = getattr(system, what)
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
    if single:
        raise SpecificationError(
            f"{what}() of env '{system.name}' returns one number, but a tuple of {size} is "
            f"expected, one for each {_entry(what)}: return {'a,' if size == 1 else 'a, b, ...'} "
            f"with its comma{'' if size == 1 else 's'}."
        )
    if len(found) != size:
        raise SpecificationError(
            f"{what}() of env '{system.name}' returns {len(found)} numbers, but {size} are "
            f"expected, one for each {_entry(what)}: correct it."
        )
    return found


def _is_single(values: Any, size: int) -> bool:
    """Return whether an equation gives one number, or one for each state, in place of a tuple."""
    if isinstance(values, np.ndarray) and values.ndim:
        return values.shape == (STATES,) and size != STATES
    return isinstance(values, int | float | np.generic | np.ndarray)


def _entry(what: str) -> str:
    return "state" if what == "known" else "learned row"
