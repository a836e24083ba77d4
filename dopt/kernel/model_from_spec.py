"""Translation of a model's specification to the structures of the compiled kernel."""

from __future__ import annotations

import numpy as np

from dopt.algorithm import FeatureKind, ModelKind
from dopt.errors import SpecificationError
from dopt.kernel import structs as args
from dopt.kernel.state_structs import Members
from dopt.models import MLP, MODELS, RFF, AffineMLP, GaussianProcess, Linear
from dopt.models.base import Model
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.types import Vector

FEATURE_KINDS = {"identity": FeatureKind.IDENTITY, "cos": FeatureKind.COS, "sin": FeatureKind.SIN}


def network_of(system: System, model: Model) -> args.Network:
    """Return the architecture of a model on a system."""
    if isinstance(model, MLP):
        kind, sizes = ModelKind.MLP, model.layer_sizes(system)
    elif isinstance(model, Linear):
        kind, sizes = ModelKind.LINEAR, (len(system.features), 1, system.n_learned)
    elif isinstance(model, RFF):
        kind, sizes = ModelKind.RANDOM_FEATURES, (len(system.features), 1, system.n_learned)
    elif isinstance(model, GaussianProcess):
        kind, sizes = ModelKind.GAUSSIAN_PROCESS, (len(system.features), 1, system.n_learned)
    else:
        raise SpecificationError(
            f"model '{model.name}' says that it is compiled, but the kernel knows "
            f"{', '.join(name for name, one in MODELS.items() if one.compiled)} alone: set "
            f"compiled = False in its class."
        )
    inputs = model.layer_inputs(system) if isinstance(model, MLP) else sizes[:-1]
    lengths = [(n_in + 1) * n_out for n_in, n_out in zip(inputs, sizes[1:], strict=True)]
    n_read = model.n_inputs_read(system)
    features = model.features(system)
    return args.Network(
        int(kind),
        np.array(sizes),
        np.array(inputs),
        np.cumsum([0, *lengths[:-1]]),
        n_read,
        n_read if isinstance(model, AffineMLP) else 0,
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
