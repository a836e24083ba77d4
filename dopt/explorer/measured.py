"""Systems that are stepped somewhere else, as an explorer sees them."""

from __future__ import annotations

import dataclasses
from typing import Any

from dopt.declare.registry import section_of
from dopt.errors import SpecificationError
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox


def measured(system: System) -> System:
    """Return a system of which nothing but its declaration is used.

    A black box, such as an environment of Gymnasium, is not started: its known part is compiled,
    and its states are those that the explorer is told.

    Raises
    ------
    SpecificationError
        If its outputs mix states: those that begin an exploration would be unknown.
    """
    if system.output_matrix:
        raise SpecificationError(
            f"env.output_matrix is {list(system.output_matrix)}, but an explorer is told states, "
            f"all of them or some: set env.measured_states, or take the outputs for states."
        )
    if not isinstance(system, BlackBox) or system.measured:
        return system
    kind, section = type(system), section_of(system)
    declared: dict[str, Any] = {
        "compiled": True,
        "measured": True,
        "to_section": lambda self: section,  # noqa: ARG005  # that of the system itself
        "__module__": kind.__module__,
    }
    explored: type[System] = dataclasses.dataclass(frozen=True, kw_only=True)(
        type(kind.__name__, (kind,), declared)
    )
    return explored(**{key.name: getattr(system, key.name) for key in dataclasses.fields(system)})
