"""Models as functions of a flat parameter vector, for ``torch.func``."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.func import functional_call

from dopt.models import MLP, RFF, AffineMLP, GaussianProcess, Linear, LinearState, Model
from dopt.systems.base import System
from dopt.systems.features import feature_values
from dopt.types import Scalar

Accelerations = Callable[[Tensor, Tensor], Tensor]
"""a_θ: parameters (q,) and a point, (d,) or (d + m,), to accelerations (r,).

A point is what the model depends on: a state, or a state and an input.
"""


@runtime_checkable
class Networked(Protocol):
    """A model that is a torch network (:class:`dopt.reference.module.Module`)."""

    def module(self, system: System) -> nn.Module: ...


def model_function(system: System, model: Model) -> Accelerations:
    """Return a_θ of a registered model."""
    if isinstance(model, AffineMLP):
        return network_function(system, AffineNetwork(model, system), model)
    if isinstance(model, MLP):
        return network_function(system, tanh_network(model.layer_sizes(system)), model)
    if isinstance(model, Linear):
        return linear_function(system)
    if isinstance(model, LinearState):
        return linear_state_function(system)
    if isinstance(model, RFF):
        return rff_function(system, model)
    if isinstance(model, GaussianProcess):
        return process_function(system, model)
    if isinstance(model, Networked):
        return network_function(system, model.module(system))
    raise TypeError(f"model {model!r} is no Module and none of this package: give its module.")


def features(system: System, x: Tensor, model: Model | None = None) -> Tensor:
    """Return the features, (..., p), of states (..., d), or of points of a model."""
    kinds, scales = system.features, system.feature_scales
    if model is not None:
        kinds, scales = model.features(system), model.feature_scales(system)
    return torch.stack(feature_values(kinds, scales, x.unbind(-1)), dim=-1)


def tanh_network(sizes: tuple[int, ...]) -> nn.Sequential:
    """Return a stack of linear layers with tanh between them."""
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes):
        layers += [nn.Linear(n_in, n_out, dtype=torch.float64), nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class AffineNetwork(nn.Module):
    """a(x) + B(x) u from the features of x and u/γ (:class:`dopt.models.AffineMLP`)."""

    def __init__(self, model: AffineMLP, system: System) -> None:
        super().__init__()
        *below, r = model.layer_sizes(system)
        self.n_inputs = system.n_inputs
        self.hidden = nn.Sequential(*tanh_network((*below,)), nn.Tanh())
        last = model.layer_inputs(system)[-1]
        self.output = nn.Linear(last, r, dtype=torch.float64)

    def forward(self, phi: Tensor) -> Tensor:
        """Return accelerations, (..., r), of features (..., p)."""
        u = phi[..., -self.n_inputs :]
        h = self.hidden(phi[..., : -self.n_inputs])
        products = [h * u[..., j : j + 1] for j in range(self.n_inputs)]
        out: Tensor = self.output(torch.cat([h, *products, u], dim=-1))
        return out


def network_function(
    system: System, module: nn.Module, model: Model | None = None
) -> Accelerations:
    """Return a_θ for any module that maps the features, (p,), to accelerations, (r,).

    The features are those of a state, or those of the points of a model.
    The flat vector holds the module's parameters in the order of ``module.named_parameters()``.
    """
    shapes = {name: parameter.shape for name, parameter in module.named_parameters()}
    lengths = [shape.numel() for shape in shapes.values()]
    buffers = dict(module.named_buffers())

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        parts = theta.split(lengths)
        weights = {
            name: part.view(shape)
            for (name, shape), part in zip(shapes.items(), parts, strict=True)
        }
        weights |= {name: buffer.to(x.device) for name, buffer in buffers.items()}
        out: Tensor = functional_call(module, weights, (features(system, x, model),))
        return out

    return accelerations


def linear_function(system: System) -> Accelerations:
    """Return offset(x) + Ψ(x) θ in the system's ``linear_parameters``."""

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        offset, *units = (stack(system.accelerations(x.unbind(-1), p)) for p in system.linear_form)
        psi = torch.stack([unit - offset for unit in units], dim=-1)
        return offset + psi @ theta

    return accelerations


def linear_state_function(system: System) -> Accelerations:
    """Return Θ φ(x), with θ the entries of Θ row by row."""

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        out: Tensor = features(system, x) @ theta.view(system.n_learned, -1).mT
        return out

    return accelerations


def rff_function(system: System, model: RFF) -> Accelerations:
    """Return W ψ(x) of random Fourier features, with θ holding W, Ω and b."""
    p, r, D = len(system.features), system.n_learned, model.n_features

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        weights, frequencies, phases = theta.split([r * D, D * p, D])
        waves = torch.cos(features(system, x) @ frequencies.view(D, p).mT + phases)
        out: Tensor = model.scale * waves @ weights.view(r, D).mT
        return out

    return accelerations


def process_function(system: System, model: GaussianProcess) -> Accelerations:
    """Return the posterior mean of a Gaussian process, with θ holding the samples and α."""
    T, p, r = system.horizon, len(system.features), system.n_learned

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        centers, alpha = theta.split([T * p, T * r])
        values = kernel(model, features(system, x).unsqueeze(-2), centers.view(T, p))
        out: Tensor = (values @ alpha.view(T, r)).squeeze(-2)
        return out

    return accelerations


def kernel(model: GaussianProcess, phi: Tensor, other: Tensor) -> Tensor:
    """Return k, (..., N, N'), between features (..., N, p) and (..., N', p)."""
    squares = (phi.unsqueeze(-2) - other.unsqueeze(-3)).square().sum(dim=-1)
    return model.amplitude**2 * torch.exp(-0.5 / model.lengthscale**2 * squares)


def stack(values: Sequence[Scalar]) -> Tensor:
    """Stack scalars, some of which may be plain numbers, along a new last axis."""
    like = next(value for value in values if isinstance(value, Tensor))
    tensors = [torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in values]
    return torch.stack(list(torch.broadcast_tensors(*tensors)), dim=-1)
