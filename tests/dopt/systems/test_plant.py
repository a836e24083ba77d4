"""Plants declared by expressions, evaluation grids, and what a model may know."""

from __future__ import annotations

import dataclasses
import math
import pickle
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopt import Plant, unknown
from dopt.assessment import true_parameters
from dopt.errors import SpecificationError
from dopt.kernel.equations import compiled_equations
from dopt.systems import SYSTEMS, Chain, System, system_from_mapping
from dopt.systems.expressions import compiled_text
from tests.dopt.explorer.plants import MOTOR
from tests.dopt.systems.strategies import NAMES, inputs, states, systems, vectors

CRANE = Plant(
    states={"place": "m", "speed": "m/s", "tilt": "rad", "spin": "rad/s"},
    inputs={"left": "N", "right": "N"},
    dt=0.01,
    gamma=3.0,
    known={
        "place": "speed",
        "speed": "(left + right) / mass",
        "tilt": "spin",
        "spin": "where(spin > 0, 2, 1) * (left - right) * cos(tilt) - sign(spin)",
    },
    constants={"mass": 2.0},
    learned=["spin", "speed"],
    angles=["tilt"],
    box={"spin": 4.0, "speed": 2.0},
)


def test_a_declaration_is_a_system() -> None:
    system = CRANE.system(7)
    assert (system.n_states, system.n_inputs, system.n_learned, system.horizon) == (4, 2, 2, 7)
    assert system.state_labels == ("place [m]", "speed [m/s]", "tilt [rad]", "spin [rad/s]")
    assert system.learned_rows == (3, 1)
    found = [(f.kind, f.index) for f in system.features]
    assert found == [("identity", 1), ("cos", 2), ("sin", 2), ("identity", 3)]
    assert system.feature_scales == (2.0, 1.0, 1.0, 4.0)
    assert system.grid_box() == {1: (-2.0, 2.0), 2: (-np.pi, np.pi), 3: (-4.0, 4.0)}
    assert np.isnan(system.learned(np.zeros((4, 4)))).all(), "what is learned is unknown"
    with pytest.raises(SpecificationError, match="not affine"):
        dataclasses.replace(CRANE, known={"speed": "left + right + 0.1 * left * right"})


def test_the_known_part_is_that_of_the_expressions_in_python_and_compiled() -> None:
    system, x, u = CRANE.system(7), (0.3, -0.5, 0.7, -1.1), (0.4, -0.9)
    expected = [-0.5, -0.25, -1.1, 1.3 * np.cos(0.7) + 1.0]
    assert np.allclose(system.known(x, u, system.parameters), expected, rtol=1e-15)
    out = np.empty(4)
    equations = compiled_equations(system)
    equations.known(np.array(x), np.array(u), np.array(system.parameters), out)
    assert np.allclose(out, expected, rtol=1e-15)
    states = np.array([x, x])
    flow = system.known(tuple(states.T), u, system.parameters)
    assert np.allclose(np.broadcast_arrays(*flow)[3], expected[3])


@pytest.mark.parametrize("plant", [MOTOR, CRANE])
def test_a_plant_is_read_back_from_its_section(plant: Plant) -> None:
    system = plant.system(9)
    again = system_from_mapping(system.to_section())
    assert again.to_section() == system.to_section()  # type: ignore[attr-defined]
    assert (again.state_labels, again.learned_rows) == (system.state_labels, system.learned_rows)
    assert again.horizon == 9


def test_an_unknown_number_of_a_file_may_have_a_value_alone() -> None:
    declared = {field.name: getattr(MOTOR, field.name) for field in dataclasses.fields(MOTOR)}
    plant = Plant.from_mapping({**declared, "constants": {"gain": {"value": 40.0}}})
    assert plant.constants == {"gain": unknown(40.0)}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"states": {}}, "a plant has no states"),
        ({"states": {"angle": "rad", "2": "V"}}, "has the name '2'"),
        ({"states": {"angle": "rad", "lambda": "V"}}, "has the name 'lambda'"),
        ({"states": {"sin": "rad", "rate": "rad/s"}}, "a function of expressions"),
        ({"inputs": {"rate": "V"}}, "'rate' more than once"),
        ({"learned": ["speed"]}, "'learned' of a plant 'speed' is unknown"),
        ({"box": {"rat": 1.0}}, "did you mean 'rate'"),
        ({"box": {"rate": -1.0}}, "'box['rate']' of a plant is -1.0"),
        ({"box": ["rate"]}, "'box' of a plant is ['rate'], but a mapping"),
        ({"states": ["angle", "rate"]}, "a mapping of names is expected"),
        ({"learned": "rate"}, "'learned' of a plant is 'rate', but a list"),
        ({"learned": ["rate", "rate"]}, "names no state twice"),
        ({"angles": [{}]}, "'angles' of a plant is [{}], but a list of names of states"),
        ({"dt": 0.0}, "'dt' of a plant is 0.0, but a positive number"),
        ({"gamma": "6"}, "'gamma' of a plant is '6'"),
        ({"limit": float("inf")}, "'limit' of a plant is inf"),
        ({"constants": {"gain": float("nan")}}, "'constants['gain']' of a plant is nan"),
        ({"constants": {"_gain": 1.0}}, "has the name '_gain'"),
        ({"constants": {"\u00b5": 1.0}}, "has the name '\u00b5'"),
        ({"known": {"angle": "rate", "rate": "voltage**2"}}, "not affine in its inputs"),
        ({"known": {"rate": "gain * magnitude(voltage)"}}, "not affine in its inputs"),
        ({"known": {"rate": "where(voltage > 0, gain, 1) * voltage"}}, "not affine"),
        ({"known": {"rate": "voltage * 9**9**9"}}, "the known part of a plant fails"),
        ({"known": {"rate": "voltage | 1"}}, "holds voltage | 1"),
        ({"known": {"rate": "(angle > 0) * voltage"}}, "holds angle > 0"),
        (
            {"known": {"rate": "where(0 < angle < 1, 1, 2) * voltage"}},
            "not one comparison by < or >",
        ),
        ({"known": {"rate": "sin(1, 2) * voltage"}}, "gives sin 2 arguments, not 1"),
        ({"known": {"rate": "gain * volt"}}, "did you mean 'voltage'"),
        ({"known": {"rate": "exp(voltage)"}}, "function of known"),
        ({"known": {"rate": "__import__('os').system('true')"}}, "holds"),
        ({"known": {"rate": "voltage.real"}}, "holds voltage.real"),
        ({"known": {"rate": "'text'"}}, "holds 'text'"),
        ({"known": {"rate": "abs(angle) + voltage"}}, "expected: write magnitude(x)."),
        ({"known": {"rate": "angle^2 + voltage"}}, "holds angle ^ 2 + voltage"),
        ({"known": {"rate": "angle^2 + voltage"}}, "expected: write x ** y for a power."),
        ({"known": {"rate": "sqrt(angle) + voltage"}}, "expected: write x ** 0.5."),
        ({"known": {"rate": "voltage +"}}, "cannot be read"),
        ({"angles": [], "box": {}}, "neither a box nor angles"),
    ],
)
def test_wrong_declarations_are_refused(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(SpecificationError, match=re.escape(said)):
        dataclasses.replace(MOTOR, **changed)


@pytest.mark.parametrize(
    ("rate", "part", "constants"),
    [
        ("voltage/J", "voltage / J", {"J": 0.0}),
        ("voltage/J", "voltage / J", {"J": 1e-320}),
        ("voltage/(m*J)", "voltage / (m * J)", {"m": 0.0, "J": 2.0}),
        ("voltage/(J*cos(angle))", "voltage / (J * cos(angle))", {"J": 0.0}),
        ("where(angle > 0, voltage/J, voltage)", "voltage / J", {"J": 0.0}),
        ("k**0.5*voltage", "k ** 0.5", {"k": -1.0}),
        ("voltage*k*k", "voltage * k * k", {"k": 1e300}),
        ("voltage/(rate-rate)", "voltage / (rate - rate)", {}),
        ("0*angle/J+voltage", "0.0 * angle / J", {"J": 0.0}),
    ],
)
def test_constants_with_which_a_part_is_finite_nowhere_are_refused(
    rate: str, part: str, constants: dict[str, float]
) -> None:
    changed = {"known": {"angle": "rate", "rate": rate}, "constants": constants}
    named = ", ".join(f"{name} = {value:g}" for name, value in constants.items() if name in part)
    with pytest.raises(SpecificationError, match=re.escape(f"of which {part} is finite nowhere")):
        dataclasses.replace(MOTOR, **changed)
    with pytest.raises(SpecificationError, match=re.escape(f" with {named}," if named else ",")):
        dataclasses.replace(MOTOR, **changed)


@pytest.mark.parametrize(
    "rate",
    [
        "where(angle > 2, gain, 0) * voltage",
        "gain * voltage - magnitude(angle) / angle",
        "voltage/angle",
        "(angle - 300)**0.5 + voltage",
        "voltage/(angle - rate)",
        "voltage/J",
    ],
)
def test_effects_poles_and_domains_of_states_are_left_to_the_user(rate: str) -> None:
    constants = {"J": 1e-9, "gain": 5.0}
    dataclasses.replace(MOTOR, known={"angle": "rate", "rate": rate}, constants=constants)


def test_a_plant_is_a_copy_and_can_be_pickled() -> None:
    constants = {"gain": 5.0}
    plant = dataclasses.replace(MOTOR, constants=constants)
    constants["gain"] = 50.0
    again = pickle.loads(pickle.dumps(plant))
    assert again == plant
    assert plant.to_section()["constants"] == again.system(3).plant.constants == {"gain": 5.0}


full = pytest.mark.parametrize(
    "name", [name for name in NAMES if not SYSTEMS[name].low_discrepancy]
)


@full
@given(data=st.data())
def test_the_grid_fills_its_box_evenly(name: str, data: st.DataObject) -> None:
    cls = SYSTEMS[name]
    axes = len(cls.grid_indices)
    counts = tuple(data.draw(st.lists(st.integers(1, 5), min_size=axes, max_size=axes)))
    widths = tuple(data.draw(st.lists(st.floats(0.1, 9.0), min_size=axes, max_size=axes)))
    system = cls(grid_points=counts, grid_half_widths=widths)
    grid = system.grid()
    assert grid.shape == (math.prod(counts), system.n_states)
    assert len(np.unique(grid, axis=0)) == len(grid)
    for index, count, width in zip(cls.grid_indices, counts, widths, strict=True):
        cells = (grid[:, index] + width) / (2 * width) * count
        assert cells - np.floor(cells) == pytest.approx(0.5)
        assert np.bincount(np.floor(cells).astype(int)).tolist() == [len(grid) // count] * count
    others = [i for i in range(system.n_states) if i not in cls.grid_indices]
    assert not grid[:, others].any()


@settings(max_examples=10)
@given(st.integers(1, 4), st.integers(0, 9))
def test_a_low_discrepancy_set_takes_every_midpoint_of_every_axis_once(
    n_links: int, exponent: int
) -> None:
    n = 2**exponent
    chain = Chain(n_links=n_links, grid_points=(n,), grid_half_widths=(1.5, 4.0))
    grid = chain.grid()
    assert grid.shape == (n, 2 * n_links)
    for column, width in zip(grid.T, chain.grid_half_widths, strict=True):
        midpoints = (2 * np.arange(n) + 1 - n) / n * width
        assert np.sort(column) == pytest.approx(midpoints, abs=1e-12)
    with pytest.raises(SpecificationError, match=r"grid_points is \[1000\], .* to 512 or 1024"):
        Chain(grid_points=(1000,))


def test_a_low_discrepancy_set_is_closer_to_the_mean_over_the_box_than_random_points() -> None:
    widths = np.array([1.0, 2.0] * 5)
    exact = np.prod(np.sin(widths / 3) / (widths / 3))
    random = np.random.default_rng(0).uniform(-widths, widths, (100, 1024, 10))
    grid = Chain(grid_points=(1024,), grid_half_widths=(1.0, 2.0)).grid()
    errors = np.abs(np.cos(random / 3).prod(axis=-1).mean(axis=1) - exact)
    assert abs(np.cos(grid / 3).prod(axis=1).mean() - exact) < 0.1 * np.median(errors)


def test_expressions_keep_their_order_and_arguments_may_be_called_like_quantities() -> None:
    function = compiled_text({"first": "a - b", "second": "2**b"}, {"x": ["a", "b"], "p": []})
    assert function((5, 3), ()) == (2, 8)
    names: dict[str, Any] = {"states": {"states": "m"}, "inputs": {"inputs": "N"}}
    more: dict[str, Any] = {"constants": {"constants": 2.0}, "box": {"states": 1.0}}
    known = {"states": "inputs * constants"}
    plant = Plant(**names, **more, dt=0.1, gamma=1.0, known=known, learned=["states"])
    assert plant.system(1).known((0.5,), (0.25,), (2.0,)) == (0.5,)


EACH_SYSTEM = pytest.mark.parametrize("name", NAMES)


def regressors(system: System, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the offset, (r,), and Psi, (r, number of parameters)."""
    point = system.points(x[None], u[None])[0]
    offset, *units = (np.array(system.accelerations(tuple(point), p)) for p in system.linear_form)
    return offset, np.stack(units, axis=-1) - offset[:, None]


@EACH_SYSTEM
@settings(max_examples=15)
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


@EACH_SYSTEM
def test_features_and_linear_parameters_fit_the_grid(name: str) -> None:
    """Features are of order one there, and the linear parameters can be told apart."""
    system = SYSTEMS[name]()
    u, grid = np.full(system.n_inputs, system.gamma), system.grid()
    psi = np.concatenate([regressors(system, x, u)[1] for x in grid])
    assert np.linalg.matrix_rank(psi) == len(system.linear_parameters)
    sizes = np.abs(system.featurize(grid)).max(axis=0)
    assert np.all((sizes > 0.3) & (sizes <= 1.0))


@EACH_SYSTEM
@settings(max_examples=15)
@given(data=st.data())
def test_inputs_enter_linearly_and_states_through_the_features_alone(
    name: str, data: st.DataObject
) -> None:
    system, x = data.draw(systems(name)), data.draw(states(name))
    u, factor = data.draw(inputs(name)), data.draw(st.floats(-3.0, 3.0))
    zero = np.zeros(system.n_inputs)
    rest = system.derivative(x, zero)
    change, scaled = (system.derivative(x, v) - rest for v in (u, factor * u))
    assert scaled == pytest.approx(factor * change, abs=1e-10 * (1 + np.abs(rest).max()))
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
    # One state and many states give the same.
    known = np.array(system.known(tuple(x), tuple(zero), system.parameters))
    assert (rest - known)[list(system.learned_rows)] == pytest.approx(first, rel=1e-12, abs=1e-10)
