"""Models that are learned: networks, a form linear in its parameters, or a Gaussian process."""

from __future__ import annotations

from dopt.models.base import MLP as MLP
from dopt.models.base import AffineMLP as AffineMLP
from dopt.models.base import BlackBoxMLP as BlackBoxMLP
from dopt.models.base import Ensemble as Ensemble
from dopt.models.base import Model as Model
from dopt.models.gaussian_process import GaussianProcess as GaussianProcess
from dopt.models.linear import RFF as RFF
from dopt.models.linear import GreyBox as GreyBox
from dopt.models.linear import Linear as Linear
from dopt.models.linear import LinearState as LinearState

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
