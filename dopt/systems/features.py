"""Features of a state, the inputs of a network: sines and cosines of angles, scaled velocities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dopt.systems.elementary import cos, sin
from dopt.types import Scalar

Kind = Literal["identity", "cos", "sin"]
KINDS: tuple[Kind, ...] = ("identity", "cos", "sin")


@dataclass(frozen=True)
class Feature:
    """One network input: ``kind`` of the state component ``index``.

    An ``identity`` feature is divided by the half-width of the evaluation grid along that
    component, so that every input of the network is of order one.
    """

    kind: Kind
    index: int


def feature_values(
    features: tuple[Feature, ...], scales: tuple[float, ...], state: Scalar
) -> list[Scalar]:
    """Return the features of a state, given as a sequence of d scalars, arrays or tensors."""
    maps = {"identity": lambda x: x, "cos": cos, "sin": sin}
    return [
        maps[feature.kind](state[feature.index]) / scale
        for feature, scale in zip(features, scales, strict=True)
    ]
