"""Physical systems, and the registry that names them."""

from __future__ import annotations

from collections.abc import Mapping

from dopt.registry import TARGET, build
from dopt.systems import plant
from dopt.systems.arm import Arm, Chain
from dopt.systems.base import Feature, System
from dopt.systems.black_box import BlackBox
from dopt.systems.cartpole import Cartpole, CartpoleUnknownGain
from dopt.systems.mujoco import MuJoCoAcrobot, MuJoCoCartpole, MuJoCoPendulum, MuJoCoReacher
from dopt.systems.oscillators import MassSpring, VanDerPol
from dopt.systems.pendulum import (
    CoupledPendulums,
    DriftingPendulum,
    Pendulum,
    PendulumUnknownGain,
    UnbalancedDisk,
)
from dopt.systems.planar import Car, MovingStar
from dopt.systems.quadrotor import Drone, Quadrotor
from dopt.systems.real import Real, real_from_mapping

SYSTEMS: dict[str, type[System]] = {
    system.name: system
    for system in (
        Pendulum,
        Cartpole,
        Arm,
        Quadrotor,
        MassSpring,
        DriftingPendulum,
        Chain,
        PendulumUnknownGain,
        CartpoleUnknownGain,
        UnbalancedDisk,
        CoupledPendulums,
        MovingStar,
        VanDerPol,
        Car,
        Drone,
    )
}
"""Systems that are given by equations."""

SIMULATORS: dict[str, type[BlackBox]] = {
    system.name: system for system in (MuJoCoPendulum, MuJoCoCartpole, MuJoCoAcrobot, MuJoCoReacher)
}
"""Models of other simulators."""

NAMED_SYSTEMS: dict[str, type[System]] = {**SYSTEMS, **SIMULATORS}
"""Systems that a configuration section names."""


def system_from_mapping(section: Mapping[str, object]) -> System:
    """Return the system that a configuration section describes: ``name`` plus its fields.

    An entry ``plant`` describes hardware around it (:func:`dopt.systems.Real`).
    """
    if isinstance(hardware := section.get("plant"), Mapping):
        own = {key: value for key, value in section.items() if key != "plant"}
        return real_from_mapping(system_from_mapping(own), hardware)
    if section.get("name") == plant.NAME and TARGET not in section:
        return plant.Plant.from_section(section)
    return build("env", NAMED_SYSTEMS, section)


__all__ = [
    "NAMED_SYSTEMS",
    "SIMULATORS",
    "SYSTEMS",
    "Arm",
    "Car",
    "Cartpole",
    "CartpoleUnknownGain",
    "Chain",
    "CoupledPendulums",
    "DriftingPendulum",
    "Drone",
    "Feature",
    "MassSpring",
    "MovingStar",
    "Pendulum",
    "PendulumUnknownGain",
    "Quadrotor",
    "Real",
    "System",
    "UnbalancedDisk",
    "VanDerPol",
    "system_from_mapping",
]
