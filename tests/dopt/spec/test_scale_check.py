"""A system in units in which its accelerations are in thousands is warned of, with the number."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from dopt.errors import ScaleWarning
from dopt.fields import parameter
from dopt.spec.custom_system import warn_of_scale
from dopt.systems import SYSTEMS, Feature, System
from tests.dopt.trials import trial


@dataclass(frozen=True, kw_only=True)
class Motor(System):
    """DC motor: L di/dt = -R i - k ω + u, J dω/dt = k i - b ω; the current is i times ``unit``."""

    name: ClassVar[str] = "motor"
    physical: ClassVar[tuple[str, ...]] = (
        "resistance",
        "inductance",
        "constant",
        "inertia",
        "unit",
    )
    state_labels: ClassVar[tuple[str, ...]] = ("i [A]", "ω [rad/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [V]",)
    learned_rows: ClassVar[tuple[int, ...]] = (0, 1)
    features: ClassVar[tuple[Feature, ...]] = (Feature("identity", 0), Feature("identity", 1))
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (0, 1)

    resistance: float = parameter(1.0, "Ω", "positive")
    inductance: float = parameter(1e-3, "H", "positive")
    constant: float = parameter(0.05, "N m/A", "positive")
    inertia: float = parameter(5e-5, "kg m²", "positive")
    unit: float = parameter(1.0, "A", "positive")
    gamma: float = parameter(12.0, "V", "positive")
    dt: float = parameter(2e-4, "s", "positive")
    initial_state: tuple[float, ...] = parameter((0.0, 0.0))
    grid_half_widths: tuple[float, ...] = parameter((8.0, 150.0), bound="positive")
    grid_points: tuple[int, ...] = parameter((16, 16), bound="positive")

    @staticmethod
    def known(state: Any, inputs: Any, parameters: Any) -> tuple[Any, ...]:
        _, inductance, _, _, unit = parameters
        return inputs[0] / (inductance * unit), 0.0 * state[1]

    @staticmethod
    def accelerations(state: Any, parameters: Any) -> tuple[Any, ...]:
        resistance, inductance, constant, inertia, unit = parameters
        current = state[0] * unit
        voltage = -resistance * current - constant * state[1]
        return voltage / (inductance * unit), constant * current / inertia


def test_the_number_and_the_unit_are_said() -> None:
    config = trial("pendulum", "random").config
    with pytest.warns(ScaleWarning) as caught:
        dataclasses.replace(config, system=Motor())
    current, speed = (str(warning.message) for warning in caught)
    assert "i [A] in env 'motor' has a root mean square of 6.3" in current
    assert "ω [rad/s]" in speed
    assert all(text.endswith("times as large.") for text in (current, speed))


@pytest.mark.parametrize("name", sorted(SYSTEMS))
def test_the_shipped_systems_have_the_size_of_a_network(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_scale(SYSTEMS[name](), trial("pendulum", "random").model)
