"""Random systems, states and inputs."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dopt.systems import SYSTEMS, System

NAMES = sorted(SYSTEMS)


@st.composite
def systems(draw: st.DrawFn, name: str, **fixed: Any) -> System:
    """Draw a system with physical parameters between 0.2 and 5, but the fixed ones."""
    cls = SYSTEMS[name]
    names = {field.name for field in dataclasses.fields(cls)}
    named = [field for field in cls.physical if field in names]
    drawn = {field: draw(st.floats(0.2, 5.0)) for field in named if field not in fixed}
    return cls(**drawn, **fixed)


def states(name: str, bound: float = 6.0) -> st.SearchStrategy[np.ndarray]:
    drawn = vectors(len(SYSTEMS[name].state_labels), bound)
    return drawn.map(_with_unit_quaternion) if name == "drone" else drawn


def _with_unit_quaternion(state: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(state[6:10])
    turn = state[6:10] / norm if norm > 1e-3 else np.array([1.0, 0.0, 0.0, 0.0])
    return np.concatenate([state[:6], turn, state[10:]])


def inputs(name: str, bound: float = 10.0) -> st.SearchStrategy[np.ndarray]:
    return vectors(len(SYSTEMS[name].input_labels), bound)


def vectors(size: int, bound: float) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, size, elements=st.floats(-bound, bound))
