"""A plant held for compiled functions that are called thousands of times.

Numba takes the pointers to its equations apart at each call from Python, for some tenths of a
millisecond; here that is done once.
"""

from __future__ import annotations

from typing import NamedTuple

from numba import types
from numba.experimental import structref

from dopt.kernel.compiler import compiled
from dopt.kernel.plain import or_plain
from dopt.kernel.structs import Plant


@structref.register
class HeldPlantType(types.StructRef):  # type: ignore[misc]  # numba has no types
    """Type of :class:`HeldPlant` in compiled code."""


class HeldPlant(structref.StructRefProxy):  # type: ignore[misc]
    """A plant that is passed on as one word."""

    plant: Plant


class PlainPlant(NamedTuple):
    """What stands for it in the interpreter (:mod:`dopt.kernel.plain`)."""

    plant: Plant


structref.define_proxy(HeldPlant, HeldPlantType, ("plant",))


@or_plain(PlainPlant)
@compiled
def hold_plant(plant: Plant) -> HeldPlant:
    """Return a plant as one."""
    return HeldPlant(plant)
