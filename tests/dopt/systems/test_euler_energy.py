"""Effect of Euler steps on the energy of the shipped systems where no input acts."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from dopt.evaluation import reachable_states
from dopt.systems import System, system_from_mapping
from tests.dopt.systems.mechanics import MECHANICS
from tests.pages import PAGES
from tests.paths import CONF

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
    energy = torch.func.vmap(MECHANICS[type(system)](system).energy)
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
    rng = np.random.default_rng(0)
    for _ in range(20):
        state = np.array(system.equilibrium, dtype=float)
        state[0::2] += rng.uniform(-1.0, 1.0, system.n_states // 2)
        after = state + system.dt * system.derivative(state, np.zeros(system.n_inputs))
        before, later = energies(system, np.stack([state, after]))
        assert later > before
