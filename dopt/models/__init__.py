"""Models that are learned: networks, a form linear in its parameters, or a Gaussian process."""

from __future__ import annotations

from dopt.models.base import MLP, AffineMLP, BlackBoxMLP, Ensemble, Model
from dopt.models.gaussian_process import GaussianProcess
from dopt.models.linear import RFF, GreyBox, Linear, LinearState

MODELS: dict[str, type[Model]] = {
    model.name: model
    for model in (
        MLP,
        Ensemble,
        AffineMLP,
        BlackBoxMLP,
        Linear,
        LinearState,
        RFF,
        GaussianProcess,
        GreyBox,
    )
}

__all__ = [
    "MLP",
    "MODELS",
    "RFF",
    "AffineMLP",
    "BlackBoxMLP",
    "Ensemble",
    "GaussianProcess",
    "GreyBox",
    "Linear",
    "LinearState",
    "Model",
]
