"""Models that are learned: a network, a form linear in its parameters, or a Gaussian process."""

from __future__ import annotations

from dopt.models.base import Model
from dopt.models.gaussian_process import GaussianProcess
from dopt.models.linear import Linear
from dopt.models.linear_state import LinearState
from dopt.models.mlp import MLP
from dopt.models.rff import RFF

MODELS: dict[str, type[Model]] = {
    model.name: model for model in (MLP, Linear, LinearState, RFF, GaussianProcess)
}

__all__ = ["MLP", "MODELS", "RFF", "GaussianProcess", "Linear", "LinearState", "Model"]
