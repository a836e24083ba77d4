"""Knowledge of a system that a learner is given: features, and the form that an oracle knows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopt.assessment import true_parameters
from dopt.systems import SYSTEMS, System
from tests.dopt.systems.strategies import NAMES, inputs, states, systems, vectors

pytestmark = pytest.mark.parametrize("name", NAMES)


def regressors(system: System, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the offset, (r,), and Psi, (r, number of parameters)."""
    point = system.points(x[None], u[None])[0]
    offset, *units = (np.array(system.accelerations(tuple(point), p)) for p in system.linear_form)
    return offset, np.stack(units, axis=-1) - offset[:, None]


@settings(max_examples=50)
@given(data=st.data())
def test_accelerations_are_affine_in_the_linear_parameters(name: str, data: st.DataObject) -> None:
    system, x, u = data.draw(systems(name)), data.draw(states(name)), data.draw(inputs(name))
    offset, psi = regressors(system, x, u)
    theta = data.draw(vectors(len(system.linear_parameters), 5.0).map(np.abs))
    values = dict(zip(system.physical, system.parameters, strict=True))
    values |= dict(zip(system.linear_parameters, theta.tolist(), strict=True))
    scale = 1.0 + np.abs(offset) + np.abs(psi) @ theta
    point = (*x, *u) if system.reads_inputs else tuple(x)
    expected = np.array(system.accelerations(point, tuple(values.values())))
    assert (offset + psi @ theta) / scale == pytest.approx(expected / scale, abs=1e-12)
    assert offset + psi @ true_parameters(system) == pytest.approx(
        system.learned(x[None], inputs=u[None])[0], rel=1e-12, abs=1e-12 * scale.max()
    )


def test_the_linear_parameters_can_be_told_apart_on_the_grid(name: str) -> None:
    system = SYSTEMS[name]()
    u = np.full(system.n_inputs, system.gamma)
    psi = np.concatenate([regressors(system, x, u)[1] for x in system.grid()])
    assert np.linalg.matrix_rank(psi) == len(system.linear_parameters)


@settings(max_examples=50)
@given(data=st.data())
def test_the_input_enters_linearly(name: str, data: st.DataObject) -> None:
    system, x = data.draw(systems(name)), data.draw(states(name))
    u, factor = data.draw(inputs(name)), data.draw(st.floats(-3.0, 3.0))
    rest = system.derivative(x, np.zeros(system.n_inputs))
    change = system.derivative(x, u) - rest
    scaled = system.derivative(x, factor * u) - rest
    assert scaled == pytest.approx(factor * change, abs=1e-10 * (1 + np.abs(rest).max()))


@settings(max_examples=50)
@given(data=st.data())
def test_accelerations_depend_on_the_state_through_the_features_alone(
    name: str, data: st.DataObject
) -> None:
    system, x = data.draw(systems(name)), data.draw(states(name))
    moved = x.copy()
    for index in system.angle_indices:
        moved[index] += 2 * np.pi * data.draw(st.integers(-3, 3))
    unseen = set(range(system.n_states)) - {feature.index for feature in system.features}
    for index in unseen:
        moved[index] = data.draw(st.floats(-10.0, 10.0))
    both = np.stack([x, moved])
    phi = system.featurize(both)
    assert phi[1] == pytest.approx(phi[0], abs=1e-13)
    first, second = system.learned(both)
    assert second == pytest.approx(first, abs=1e-9 * (1.0 + np.abs(first).max()))


def test_features_are_of_order_one_on_the_grid(name: str) -> None:
    system = SYSTEMS[name]()
    sizes = np.abs(system.featurize(system.grid())).max(axis=0)
    assert np.all((sizes > 0.3) & (sizes <= 1.0))


@settings(max_examples=20)
@given(data=st.data())
def test_one_state_and_many_states_give_the_same_accelerations(
    name: str, data: st.DataObject
) -> None:
    system = data.draw(systems(name))
    some = np.stack([data.draw(states(name)) for _ in range(3)])
    for x, row in zip(some, system.learned(some), strict=True):
        flow = system.derivative(x, np.zeros(system.n_inputs))
        known = np.array(system.known(tuple(x), (0.0,) * system.n_inputs, system.parameters))
        rows = list(system.learned_rows)
        assert (flow - known)[rows] == pytest.approx(row, rel=1e-12, abs=1e-10)
