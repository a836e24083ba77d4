"""Models as functions of flat parameter vectors, for a batch of trials."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap

from dopt.models import (
    MLP,
    RFF,
    AffineMLP,
    GaussianProcess,
    GreyBox,
    Linear,
    LinearState,
    Model,
)
from dopt.systems.base import System, feature_values
from dopt.types import Scalar

BatchModel = Callable[[Tensor, Tensor], Tensor]
"""a_θ of n trials: parameters (n, q) and points (n, N, ·) to accelerations (n, N, r).

A point is what the model depends on: a state, (d,), or a state and an input, (d + m,). Points that
are the same for all trials may have 1 in the place of n.
"""


@runtime_checkable
class Networked(Protocol):
    """A model that is a torch network (:class:`dopt.reference.module.Module`)."""

    def module(self, system: System) -> nn.Module: ...


def model_function(system: System, model: Model) -> BatchModel:
    """Return a_θ of a registered model."""
    if isinstance(model, MLP):
        return mlp_function(system, model)
    if isinstance(model, Linear):
        return linear_function(system)
    if isinstance(model, LinearState):
        return linear_state_function(system)
    if isinstance(model, RFF):
        return rff_function(system, model)
    if isinstance(model, GaussianProcess):
        return process_function(system, model)
    if isinstance(model, GreyBox):
        return grey_box_function(system, model)
    if isinstance(model, Networked):
        return network_function(system, model.module(system), model)
    raise TypeError(f"model {model!r} is no Module and none of this package: give its module.")


def features(system: System, x: Tensor, model: Model | None = None) -> Tensor:
    """Return the features, (..., p), of states (..., d), or of points of a model."""
    kinds, scales = system.features, system.feature_scales
    if model is not None:
        kinds, scales = model.features(system), model.feature_scales(system)
    return torch.stack(feature_values(kinds, scales, x.unbind(-1)), dim=-1)


class Layer(NamedTuple):
    """Linear layers of n trials."""

    weights: Tensor  # (n, inputs, outputs)
    biases: Tensor  # (n, 1, outputs)

    def __call__(self, h: Tensor) -> Tensor:
        """Return the outputs, (n, N, ·), at inputs (n, N, ·)."""
        return torch.baddbmm(self.biases, h, self.weights)


def layers(theta: Tensor, shapes: Sequence[tuple[int, int]]) -> list[Layer]:
    """Cut parameters, (n, q), into layers of the shapes (inputs, outputs).

    Each layer has its matrix, outputs by inputs, and then its biases.
    """
    parts = iter(theta.split([n for n_in, n_out in shapes for n in (n_in * n_out, n_out)], dim=1))
    return [
        Layer(next(parts).unflatten(1, (n_out, n_in)).mT, next(parts).unsqueeze(1))
        for n_in, n_out in shapes
    ]


def mlp_function(system: System, model: MLP) -> BatchModel:
    """Return layers with tanh between them."""
    sizes = model.layer_sizes(system)
    shapes = list(zip(model.layer_inputs(system), sizes[1:], strict=True))
    affine = isinstance(model, AffineMLP)

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        *hidden, output = layers(theta, shapes)
        phi = features(system, x, model).expand(len(theta), -1, -1)
        h = phi[..., : sizes[0]]
        for layer in hidden:
            h = layer(h).tanh()
        return output(_with_products(h, phi[..., sizes[0] :]) if affine else h)

    return accelerations


def _with_products(h: Tensor, u: Tensor) -> Tensor:
    """Return (h, h u₁, ..., h u_m, u) for hidden units (n, N, w) and inputs (n, N, m)."""
    products = [h * column.unsqueeze(-1) for column in u.unbind(-1)]
    return torch.cat([h, *products, u], dim=-1)


def network_function(system: System, module: nn.Module, model: Model | None = None) -> BatchModel:
    """Return a_θ for any module that maps the features, (p,), to accelerations, (r,).

    The features are those of a state, or those of the points of a model.
    The flat vector holds the module's parameters in the order of ``module.named_parameters()``.
    """
    shapes = {name: parameter.shape for name, parameter in module.named_parameters()}
    lengths = [shape.numel() for shape in shapes.values()]
    buffers = dict(module.named_buffers())

    def network(theta: Tensor, phi: Tensor) -> Tensor:
        parts = theta.split(lengths)
        weights = {
            name: part.view(shape)
            for (name, shape), part in zip(shapes.items(), parts, strict=True)
        }
        weights |= {name: buffer.to(phi.device) for name, buffer in buffers.items()}
        out: Tensor = functional_call(module, weights, (phi,))
        return out

    over_points = vmap(network, in_dims=(None, 0))
    over_trials, over_both = vmap(network), vmap(over_points)

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        phi = features(system, x, model).expand(len(theta), -1, -1)
        n, points = phi.shape[:2]
        if n > 1:
            many = over_both(theta, phi) if points > 1 else over_trials(theta, phi[:, 0])
            return many.view(n, points, -1)
        one = over_points(theta[0], phi[0]) if points > 1 else network(theta[0], phi[0, 0])
        return one.view(1, points, -1)

    return accelerations


def linear_function(system: System) -> BatchModel:
    """Return offset(x) + Ψ(x) θ in the system's ``linear_parameters``."""

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        offset, *units = (stack(system.accelerations(x.unbind(-1), p)) for p in system.linear_form)
        psi = torch.stack([unit - offset for unit in units], dim=-1)
        out: Tensor = offset + (psi @ theta[:, None, :, None]).squeeze(-1)
        return out

    return accelerations


def grey_box_function(system: System, model: GreyBox) -> BatchModel:
    """Return the system's own accelerations, with θ in the place of what is unknown."""

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        values = model.physical_values(system, theta.unsqueeze(-1).unbind(1))
        rows = system.accelerations(x.unbind(-1), values)
        return stack(rows).expand(len(theta), -1, -1)

    return accelerations


def linear_state_function(system: System) -> BatchModel:
    """Return Θ φ(x), with θ the entries of Θ row by row."""

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        out: Tensor = features(system, x) @ theta.unflatten(1, (system.n_learned, -1)).mT
        return out

    return accelerations


def rff_function(system: System, model: RFF) -> BatchModel:
    """Return W ψ(x) of random Fourier features, with θ holding W, Ω and b."""
    p, r, D = len(system.features), system.n_learned, model.n_features

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        weights, frequencies, phases = theta.split([r * D, D * p, D], dim=1)
        projected = features(system, x) @ frequencies.unflatten(1, (D, p)).mT
        waves = torch.cos(projected + phases.unsqueeze(1))
        out: Tensor = model.scale * waves @ weights.unflatten(1, (r, D)).mT
        return out

    return accelerations


def process_function(system: System, model: GaussianProcess) -> BatchModel:
    """Return the posterior mean of a Gaussian process, with θ holding the samples and α."""
    T, p, r = system.horizon, len(system.features), system.n_learned

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        centers, alpha = theta.split([T * p, T * r], dim=1)
        values = kernel(model, features(system, x), centers.unflatten(1, (T, p)))
        out: Tensor = values @ alpha.unflatten(1, (T, r))
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
