"""What is learned: a network of features, or a linear form in known regressors."""

from __future__ import annotations

from dopt.models.base import Model
from dopt.models.linear import Linear
from dopt.models.mlp import MLP

MODELS: dict[str, type[Model]] = {model.name: model for model in (MLP, Linear)}

__all__ = ["MLP", "MODELS", "Linear", "Model"]
