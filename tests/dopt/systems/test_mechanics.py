"""Equations of motion: mechanics, equilibria, energy of Euler steps, integrators."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from dopt import Explorer, Plant
from dopt.errors import SpecificationError
from dopt.evaluation import reachable_states
from dopt.kernel.from_spec import plant_of
from dopt.kernel.integration import next_true_state
from dopt.offline_fit import recorded_samples
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import (
    SYSTEMS,
    Arm,
    Cartpole,
    MassSpring,
    Pendulum,
    Quadrotor,
    System,
    system_from_mapping,
)
from dopt.systems.base import INTEGRATORS, next_state
from dopt.systems.properties import eigenmode, jacobians
from tests.dopt.kernel.twin import call, relative_gap
from tests.dopt.systems.mechanics import MECHANICS, WITHOUT_INERTIA, Mechanics
from tests.dopt.systems.strategies import NAMES, inputs, states, systems
from tests.dopt.trials import trial
from tests.pages import PAGES
from tests.paths import CONF

mechanical = pytest.mark.parametrize("name", sorted(MECHANICS))


def mechanics_of(system: System) -> Mechanics:
    return MECHANICS[system.name](system)


def test_every_registered_system_with_inertia_is_held_against_masses() -> None:
    assert set(MECHANICS) == set(NAMES) - set(WITHOUT_INERTIA)


@mechanical
@settings(max_examples=5)
@given(data=st.data())
def test_equations_are_those_of_euler_and_lagrange(name: str, data: st.DataObject) -> None:
    system = data.draw(systems(name))
    x, u = data.draw(states(name)), data.draw(inputs(name))
    mechanics = mechanics_of(system)
    expected = mechanics.accelerations(torch.tensor(x), torch.tensor(u)).numpy()
    flow = torch.tensor(system.derivative(x, u))
    (_, rates), (moved, found) = torch.func.jvp(mechanics.split, (torch.tensor(x),), (flow,))
    assert moved.numpy() == pytest.approx(rates.numpy(), rel=1e-12, abs=1e-12)
    size = np.abs(expected).max() + 1.0
    assert found.numpy() == pytest.approx(expected, rel=0.0, abs=1e-9 * size)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=10)
@given(data=st.data())
def test_jacobians_are_the_slopes_of_the_flow(name: str, data: st.DataObject) -> None:
    system = data.draw(systems(name))
    x, u = data.draw(states(name, 2.0)), data.draw(inputs(name, 2.0))
    A, B = jacobians(system, x, u)
    step = 1e-5
    for slopes, point, vary in (
        (A, x, lambda dx: system.derivative(x + dx, u)),
        (B, u, lambda du: system.derivative(x, u + du)),
    ):
        moves = step * np.eye(len(point))
        numeric = np.stack([(vary(e) - vary(-e)) / (2 * step) for e in moves], axis=1)
        # |v| v of the drag bends at v = 0: a central difference is off by its step there.
        assert slopes == pytest.approx(numeric, rel=1e-5, abs=1e-3 * np.abs(slopes).max() + 1e-4)


@given(st.floats(0.2, 5.0), st.floats(0.2, 5.0), st.floats(1.0, 20.0), st.floats(0.0, 0.99))
def test_a_pendulum_swings_at_the_damped_frequency(
    mass: float, length: float, gravity: float, ratio: float
) -> None:
    natural = math.sqrt(1.5 * gravity / length)
    inertia = mass * length**2 / 3.0
    pendulum = Pendulum(
        mass=mass, length=length, gravity=gravity, friction=2.0 * ratio * natural * inertia
    )
    mode = eigenmode(pendulum)
    assert mode is not None
    assert mode.frequency == pytest.approx(natural * math.sqrt(1.0 - ratio**2), rel=1e-6)
    assert mode.decay == pytest.approx(ratio * natural, rel=1e-6, abs=1e-9)
    assert np.abs(mode.direction) == pytest.approx(1.0)


@pytest.mark.parametrize("stiffness", [7.0, 9.9, 10.0, 10.1, 11.0, 12.0, 13.0])
def test_of_equally_damped_modes_the_slowest_is_taken(stiffness: float) -> None:
    mode = eigenmode(MassSpring(stiffness=stiffness, damping=0.0))
    assert mode is not None
    assert mode.frequency == pytest.approx(math.sqrt(stiffness), rel=1e-9)


def test_a_free_cartpole_swings_against_its_cart_and_what_does_not_oscillate_has_no_mode() -> None:
    cartpole = Cartpole(cart_mass=2.0, pole_mass=0.5, length=0.7, pivot_friction=0, cart_friction=0)
    mode = eigenmode(cartpole)
    assert mode is not None
    assert mode.frequency == pytest.approx(math.sqrt(10.0 / 0.7 * (1 + 0.5 / 2.0)), rel=1e-9)
    assert eigenmode(Pendulum(friction=10.0)) is None
    assert eigenmode(Quadrotor()) is None


def test_the_arm_mode_is_a_normal_mode_driven_along_its_best_direction() -> None:
    arm = Arm(friction=1e-3)
    mode = eigenmode(arm)
    assert mode is not None
    normal = [math.sqrt((2.0 + sign * math.sqrt(2.0)) * 10.0) for sign in (-1, 1)]
    assert min(abs(mode.frequency - w) for w in normal) < 1e-4
    A, B = jacobians(arm, np.zeros(4), np.zeros(2))
    angles = np.linspace(0.0, np.pi, 721)
    directions = np.stack([np.cos(angles), np.sin(angles)])
    response = np.linalg.solve(1j * mode.frequency * np.eye(4) - A, B @ directions)
    best = directions[:, np.argmax(np.linalg.norm(response, axis=0))]
    assert abs(best @ mode.direction) > 1.0 - 1e-4
    assert np.linalg.norm(mode.direction) == pytest.approx(1.0)


AT_REST = ("arm", "cartpole", "pendulum", "chain", "drifting_pendulum", "mass_spring")
"""The systems with a stable equilibrium: the quadrotor falls."""

LEAST = 0.01
"""Share of the largest energy of a start below which its run is in no relative rise."""


def shipped(name: str) -> System:
    file = CONF / "env" / f"{name}.yaml"
    section = OmegaConf.to_container(OmegaConf.load(file)) if file.exists() else {"name": name}
    assert isinstance(section, dict)
    return system_from_mapping(section)


def energies(system: System, states: np.ndarray) -> np.ndarray:
    """Return the energies, (...,) [J], of states, (..., d), beyond that at rest."""
    energy = torch.func.vmap(mechanics_of(system).energy)
    rest = system.equilibrium or system.initial_state
    rows = torch.tensor(np.vstack([states.reshape(-1, system.n_states), rest]))
    values = energy(rows).numpy()
    return (values[:-1] - values[-1]).reshape(states.shape[:-1])


def free_runs(system: System) -> np.ndarray:
    """Return the states, (T + 1, 512, d), of runs from the reachable set, no input and no noise."""
    states = [reachable_states(system)]
    inputs = (0.0,) * system.n_inputs
    for t in range(system.horizon):
        now = states[-1]
        known = system.known(tuple(now.T), inputs, system.parameters)
        flow = np.stack(np.broadcast_arrays(*known), axis=-1)
        flow[:, list(system.learned_rows)] += system.learned(now, t)
        states.append(now + system.dt * flow)
    return np.stack(states)


def rises(name: str) -> tuple[float, float]:
    """Return the share of steps that raise the energy, and the largest rise of a run.

    The rise is relative to the energy at the start, for starts that are not close to rest.
    """
    system = shipped(name)
    path = energies(system, free_runs(system))
    share = float(np.mean(np.diff(path, axis=0) > 0))
    kept = path[:, path[0] >= LEAST * path[0].max()]
    return share, float(np.max(kept.max(axis=0) / kept[0] - 1.0))


def test_the_method_page_says_how_far_free_steps_raise_the_energy() -> None:
    found = {name: rises(name) for name in AT_REST}
    share, rise = ([value[i] for value in found.values()] for i in (0, 1))
    least, most = (min(found, key=lambda n: found[n][0]), max(found, key=lambda n: found[n][0]))
    phrases = (
        f"{100 * min(share):.0f} % ({least}) to {100 * max(share):.0f} % ({most})",
        f"{100 * min(rise):.0f} to {100 * max(rise):.0f} %",
    )
    page = " ".join(PAGES["docs/method.md"].split())
    for phrase in phrases:
        assert phrase in page


@pytest.mark.parametrize("name", AT_REST)
def test_every_euler_step_from_a_turning_point_raises_the_energy(name: str) -> None:
    """The positions stay, and the rates leave zero: a spectral radius below 1 says less."""
    system = shipped(name)
    still = system.derivative(np.array(system.equilibrium), np.zeros(system.n_inputs))
    assert still == pytest.approx(0.0, abs=1e-14), "nothing moves at rest"
    rng = np.random.default_rng(0)
    for _ in range(20):
        state = np.array(system.equilibrium, dtype=float)
        state[0::2] += rng.uniform(-1.0, 1.0, system.n_states // 2)
        after = state + system.dt * system.derivative(state, np.zeros(system.n_inputs))
        before, later = energies(system, np.stack([state, after]))
        assert later > before


def integrated(
    env: str, policy: str = "d_optimal", seed: int = 0, /, *, horizon: int = 25, **fields: Any
) -> TrialSpec:
    """Return a small trial with Runge-Kutta steps."""
    return trial(env, policy, seed, env={"horizon": horizon, "integrator": "rk4", **fields})


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("rk4", 4)])
def test_errors_shrink_by_the_order_of_the_method(integrator: str, order: int) -> None:
    """On an oscillator, whose solution is known, halving dt divides the error by 2^order."""

    def end(n: int) -> np.ndarray:
        x = np.array([1.0, 0.0])
        for _ in range(n):
            x = next_state(integrator, lambda z: np.array([z[1], -z[0]]), x, 1.0 / n)
        return x

    truth = np.array([np.cos(1.0), -np.sin(1.0)])
    errors = [np.linalg.norm(end(n) - truth) for n in (20, 40)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", sorted(SYSTEMS))
def test_numpy_torch_and_the_kernel_take_the_same_step(name: str, integrator: str) -> None:
    system: System = SYSTEMS[name](integrator=integrator)
    rng = np.random.default_rng(0)
    x, u = rng.standard_normal(system.n_states), rng.standard_normal(system.n_inputs)
    expected = next_state(integrator, lambda z: system.derivative(z, u), x, system.dt)
    plant, out = plant_of(system), np.empty(system.n_states)
    call(next_true_state, plant, plant.history[0], x, u, out)
    np.testing.assert_allclose(out, expected, rtol=1e-13, atol=1e-15)

    def rate(z: torch.Tensor) -> torch.Tensor:
        return torch.tensor(system.derivative(z.numpy(), u))

    found = next_state(integrator, rate, torch.tensor(x), system.dt).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize(
    ("env", "policy"),
    [("quadrotor", "d_optimal"), ("quadrotor", "uniform"), ("drifting_pendulum", "oracle")],
)
def test_both_paths_agree(env: str, policy: str) -> None:
    spec = integrated(env, policy, horizon=15)
    fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
    assert relative_gap(fast.states, plain.states) < 1e-8
    assert relative_gap(fast.parameters, plain.parameters) < 1e-6
    assert relative_gap(fast.loss, plain.loss) < 1e-5


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm"])
def test_the_oracle_learns_the_parameters_themselves(env: str) -> None:
    """Taken for Euler steps, the same states leave an error of O(dt)."""
    spec = integrated(env, "oracle", horizon=200, noise=0.0)
    result = run_trial(spec)
    assert result.loss[-1] < 1e-5
    euler = run_trial(integrated(env, "oracle", horizon=200, noise=0.0, integrator="euler"))
    assert relative_gap(result.states, euler.states) > 1e-4
    wrong = recorded_samples(SYSTEMS[env](horizon=200), result.states, result.inputs)
    truth = spec.system.learned(wrong.states)
    right = recorded_samples(spec.system, result.states, result.inputs)
    gap, small = (
        float(np.abs(samples.accelerations - spec.system.learned(samples.states)).max())
        for samples in (wrong, right)
    )
    assert small < 0.1 * gap
    assert gap > 1e-3 * float(np.abs(truth).max())


@pytest.mark.parametrize("learner", ["adam", "adam_window"])
def test_a_reset_changes_no_sample_before_it(learner: str) -> None:
    """The state in which a plant restarts replaces the one that was reached."""
    spec = integrated("pendulum", "random", horizon=40)
    explorers = [
        Explorer(spec.system, policy="random", learner=learner, path=path)
        for path in ("kernel", "reference")
    ]
    rng, x = np.random.default_rng(0), np.zeros(2)
    for k in range(40):
        x = rng.standard_normal(2) if k % 5 == 0 else x
        for explorer in explorers:
            if k % 5 == 0:
                explorer.reset()
            u = explorer.ask(x)
        x = next_state("rk4", lambda z, u=u: spec.system.derivative(z, u), x, 0.02)
        for explorer in explorers:
            explorer.tell(x)
    assert relative_gap(explorers[0].parameters, explorers[1].parameters) < 1e-7


def test_a_plant_says_its_integrator() -> None:
    given: dict[str, Any] = {
        "states": {"angle": "rad", "rate": "rad/s"}, "inputs": {"u": "V"}, "dt": 0.01, "gamma": 1.0,
        "known": {"angle": "rate", "rate": "u"}, "learned": ["rate"], "angles": ["angle"],
        "box": {"rate": 1.0},
    }  # fmt: skip
    plant = Plant(**given, integrator="rk4")
    assert Plant.from_section(plant.to_section() | {"horizon": 10}).integrator == "rk4"
    assert "integrator" not in Plant(**given).to_section()
    assert '"integrator"' not in TrialSpec.from_names("pendulum", "random").config_json
    assert '"integrator":"rk4"' in integrated("pendulum").config_json
    with pytest.raises(
        SpecificationError, match=r"integrator 'rk5' is unknown: did you mean 'rk4'"
    ):
        Plant(**given, integrator="rk5")
