"""The default values of the systems make physical sense, and are what their reasons say."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from dopt.learning import LEARNERS
from dopt.models import MODELS
from dopt.registry import build
from dopt.systems import SYSTEMS, Quadrotor
from dopt.systems.properties import euler_spectral_radius, jacobians
from tests.paths import CONF

UNSTABLE_AT_REST = {"moving_star", "van_der_pol"}
"""A star that pushes away, and an oscillator that is fed."""

GROUPS: list[tuple[str, dict[str, Any]]] = [
    ("model", MODELS),
    ("learner", LEARNERS),
]


def section_in(path: Path) -> dict[str, object]:
    section = OmegaConf.to_container(OmegaConf.merge({"width": 16}, OmegaConf.load(path)))
    assert isinstance(section, dict)
    section = section.get("policy", section)
    return {k: v for k, v in section.items() if k not in ("width", "defaults")} | (
        {"width": 16} if path.parent.name == "model" and section["name"] == "mlp" else {}
    )


def reasons_of(name: str) -> str:
    """Return the reasons for the numbers of a system, in its file or its class, on one line."""
    path = CONF / f"env/{name}.yaml"
    text = path.read_text() if path.exists() else str(SYSTEMS[name].__doc__)
    return " ".join(line.lstrip("# ") for line in text.splitlines())


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_euler_map_is_stable_where_the_system_is(name: str) -> None:
    """Where motions about rest grow, those of the map grow alike up to O(dt²)."""
    system = SYSTEMS[name]()
    rest = system.equilibrium or system.initial_state
    values = np.linalg.eigvals(jacobians(system, rest, np.zeros(system.n_inputs))[0])
    growth = values.real.max()
    if growth <= 1e-12:
        assert euler_spectral_radius(system) <= 1.0 + 1e-12
        return
    assert name in UNSTABLE_AT_REST
    farthest = (system.dt * np.abs(values).max()) ** 2
    assert euler_spectral_radius(system) <= math.exp(growth * system.dt) + farthest < 1.05


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_spectral_radius_is_the_stated_one(name: str) -> None:
    stated = re.search(r"spectral radius (0\.\d+) at rest", reasons_of(name))
    if stated:
        assert stated[1] == f"{euler_spectral_radius(SYSTEMS[name]()):.3f}"


@pytest.mark.parametrize(("name", "field"), [("chain", "friction"), ("cartpole", "pivot_friction")])
def test_the_least_friction_of_a_stable_euler_map_is_the_stated_one(name: str, field: str) -> None:
    stated = re.search(r"takes (0\.\d+) at least", reasons_of(name))
    assert stated
    bound, last_digit = float(stated[1]), 10.0 ** -(len(stated[1]) - 2)
    radii = [
        euler_spectral_radius(dataclasses.replace(SYSTEMS[name](), **{field: friction}))
        for friction in (bound - last_digit, bound)
    ]
    assert radii[0] > 1.0 + 1e-9
    assert radii[1] <= 1.0 + 1e-12


def test_the_thrust_of_the_quadrotor_is_the_stated_one() -> None:
    """The bound is one of the norm of both thrusts: equal ones have the largest sum."""
    system = Quadrotor()
    thrust, weight = math.sqrt(2.0) * system.gamma, system.mass * system.gravity
    fall, climb = (math.sqrt(force / system.drag) for force in (weight, thrust - weight))
    change = system.dt * (thrust + weight) / system.mass
    comment = reasons_of("quadrotor")
    for phrase in (
        f"{system.gamma:.0f} N is the norm of the two thrusts, whose sum reaches {thrust:.1f} N",
        f"weight of {weight:.0f} N",
        f"terminal speeds of {fall:.1f} m/s in free fall and {climb:.1f} m/s in a climb",
        f"change the speeds by at most {change:.2f} m/s in a step",
    ):
        assert phrase in comment


@pytest.mark.parametrize("name", [name for name in SYSTEMS if name != "moving_star"])
def test_a_trial_starts_close_to_rest(name: str) -> None:
    """All but that of the star, which pushes at once."""
    system = SYSTEMS[name]()
    rest = np.array(system.equilibrium or np.zeros(system.n_states))
    rest[[i for i, label in enumerate(system.state_labels) if label.startswith("e₀")]] = 1.0
    assert system.initial_state == pytest.approx(rest, abs=0.01)


@pytest.mark.parametrize(("group", "registry"), GROUPS, ids=[group for group, _ in GROUPS])
def test_every_registered_choice_has_a_file_that_loads(
    group: str, registry: dict[str, Any]
) -> None:
    paths = sorted((CONF / group).rglob("*.yaml"))
    assert paths
    built = [build(group, registry, section_in(path)) for path in paths]
    assert {item.name for item in built} == set(registry)
