"""Translation of a model's specification to the structures of the compiled kernel."""

from __future__ import annotations

import numpy as np

from dopt.algorithm import FeatureKind, ModelKind
from dopt.errors import SpecificationError
from dopt.kernel import structs as args
from dopt.kernel.state_structs import Members
from dopt.models import (
    MLP,
    MODELS,
    RFF,
    AffineMLP,
    GaussianProcess,
    GreyBox,
    Linear,
    LinearState,
)
from dopt.models.base import Model
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.types import Vector

KINDS: dict[type[Model], ModelKind] = {
    MLP: ModelKind.MLP,
    Linear: ModelKind.LINEAR,
    RFF: ModelKind.RANDOM_FEATURES,
    GaussianProcess: ModelKind.GAUSSIAN_PROCESS,
    LinearState: ModelKind.LINEAR_STATE,
    GreyBox: ModelKind.GREY_BOX,
}
"""Models that the kernel evaluates, and classes derived from them."""

FEATURE_KINDS = {"identity": FeatureKind.IDENTITY, "cos": FeatureKind.COS, "sin": FeatureKind.SIN}


def network_of(system: System, model: Model) -> args.Network:
    """Return the architecture of a model on a system."""
    kinds = [kind for one, kind in KINDS.items() if isinstance(model, one)]
    if not kinds:
        raise SpecificationError(
            f"model '{model.name}' says that it is compiled, but the kernel knows "
            f"{', '.join(name for name, one in MODELS.items() if one.compiled)} alone: set "
            f"compiled = False in its class."
        )
    features = model.features(system)
    sizes: tuple[int, ...] = (len(features), 1, system.n_learned)
    inputs = sizes[:-1]
    if isinstance(model, MLP):
        sizes, inputs = model.layer_sizes(system), model.layer_inputs(system)
    lengths = [(n_in + 1) * n_out for n_in, n_out in zip(inputs, sizes[1:], strict=True)]
    n_read = model.n_inputs_read(system)
    unknown = model.names(system) if isinstance(model, GreyBox) else ()
    return args.Network(
        int(kinds[0]),
        np.array(sizes),
        np.array(inputs),
        np.cumsum([0, *lengths[:-1]]),
        n_read,
        n_read if isinstance(model, AffineMLP) else 0,
        np.array([system.physical.index(name) for name in unknown], dtype=np.int64),
        np.array([FEATURE_KINDS[feature.kind] for feature in features]),
        np.array([feature.index for feature in features]),
        np.array(model.feature_scales(system)),
        args.Waves(np.zeros((0, 0)), np.zeros(0), 1.0),
        _process(system, model),
    )


def _process(system: System, model: Model) -> args.Process:
    if isinstance(model, GaussianProcess):
        return args.Process(model.lengthscale, model.amplitude, model.noise_variance(system))
    return args.Process(1.0, 1.0, 1.0)


def network_of_trial(spec: TrialSpec, network: args.Network, weights: Vector) -> args.Network:
    """Return the architecture with the random features that a trial has drawn in its weights."""
    if not isinstance(spec.model, RFF):
        return network
    D, p = spec.model.n_features, len(spec.system.features)
    frequencies, phases = weights[-D * (p + 1) : -D].reshape(D, p), weights[-D:]
    waves = args.Waves(frequencies.copy(), phases.copy(), spec.model.scale)
    return network._replace(waves=waves)


def members_of(model: Model, weights: Vector) -> Members:
    """Return the networks of an ensemble with the parameters that a trial has drawn for them."""
    count = model.n_members if model.n_members > 1 else 0
    drawn = weights.reshape(count, -1) if count else np.zeros((0, 0))
    return Members(drawn.copy(), drawn.copy())
