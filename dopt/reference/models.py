"""Models and dynamics over tensors, for a batch of trials, and a user's torch network.

All items of a derivative are taken together: each has parameters of its own, so that the gradient
of a sum over the items holds the gradient of each.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.nn.utils import parameters_to_vector

from dopt.errors import SpecificationError
from dopt.models import MLP, Linear, Model
from dopt.models.base import Array
from dopt.registry import SOURCE, TARGET, check_source, imported, source_digest
from dopt.systems.base import System, feature_values, next_state
from dopt.types import Scalar

BatchModel = Callable[[Tensor, Tensor], Tensor]
"""a_θ of n trials: parameters (n, q) and states (n, N, d) to accelerations (n, N, r).

States that are the same for all trials may have 1 in the place of n.
"""


@runtime_checkable
class Networked(Protocol):
    """A model that is a torch network (:class:`dopt.reference.models.Module`)."""

    def module(self, system: System) -> nn.Module: ...


def model_function(system: System, model: Model) -> BatchModel:
    """Return a_θ of a model: a network, or the linear form of physics."""
    if isinstance(model, MLP):
        return mlp_function(system, model)
    if isinstance(model, Linear):
        return linear_function(system)
    if isinstance(model, Networked):
        return network_function(system, model.module(system))
    raise TypeError(f"model {model!r} is no network and not linear: run it in the kernel.")


def features(system: System, x: Tensor) -> Tensor:
    """Return the features, (..., p), of states (..., d)."""
    values = feature_values(system.features, system.feature_scales, x.unbind(-1))
    return torch.stack(values, dim=-1)


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
    shapes = list(zip(model.layer_inputs(system), model.layer_sizes(system)[1:], strict=True))

    def accelerations(theta: Tensor, x: Tensor) -> Tensor:
        *hidden, output = layers(theta, shapes)
        h = features(system, x).expand(len(theta), -1, -1)
        for layer in hidden:
            h = layer(h).tanh()
        return output(h)

    return accelerations


def network_function(system: System, module: nn.Module) -> BatchModel:
    """Return a_θ for any module that maps the features, (p,), to accelerations, (r,).

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
        phi = features(system, x).expand(len(theta), -1, -1)
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


def stack(values: Sequence[Scalar]) -> Tensor:
    """Stack scalars, some of which may be plain numbers, along a new last axis."""
    like = next(value for value in values if isinstance(value, Tensor))
    tensors = [torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in values]
    return torch.stack(list(torch.broadcast_tensors(*tensors)), dim=-1)


def known_flow(system: System, x: Tensor, u: Tensor) -> Tensor:
    """Return the known part of dx/dt, (..., d), for states (..., d) and inputs (..., m)."""
    return stack(system.known(x.unbind(-1), u.unbind(-1), system.parameters))


def true_accelerations(system: System, x: Tensor, u: Tensor, step: int) -> Tensor:
    """Return a at a step, (..., r), for states (..., d) and inputs (..., m)."""
    parameters = system.history[min(step, len(system.history) - 1)].tolist()
    point = torch.cat([x, u], dim=-1) if system.reads_inputs else x
    return stack(system.accelerations(point.unbind(-1), parameters))


def next_states(
    system: System, x: Tensor, u: Tensor, accelerations: Callable[[Tensor], Tensor], dt: float
) -> Tensor:
    """Return the states, (..., d), dt seconds after (..., d) under held inputs, (..., m).

    ``accelerations`` gives those, (..., r), of states.
    """
    rows = torch.tensor(system.learned_rows, device=x.device)

    def rate(z: Tensor) -> Tensor:
        return known_flow(system, z, u).index_add(-1, rows, accelerations(z))

    following: Tensor = next_state(system.integrator, rate, x, dt)
    return following


def model_states(
    system: System, model: BatchModel, theta: Tensor, x: Tensor, u: Tensor, dt: float
) -> Tensor:
    """Return what a model predicts dt seconds later, (n, d), for (n, q), (n, d) and (n, m)."""
    return next_states(system, x, u, lambda z: model(theta, z.unsqueeze(1)).squeeze(1), dt)


def input_matrix(system: System, x: Tensor) -> Tensor:
    """Return B = dt ∂known/∂u, (n, d, m), at states (n, d)."""
    n, d = x.shape
    with torch.enable_grad():
        u = x.new_zeros(n, d, system.n_inputs).requires_grad_()
        known = known_flow(system, x.unsqueeze(1).expand(-1, d, -1), u)
        # The i-th of d copies of the input is what the i-th state is differentiated by.
        total = known.diagonal(dim1=1, dim2=2).sum()
        if not total.requires_grad:
            return torch.zeros_like(u)
        (columns,) = torch.autograd.grad(total, u)
    return system.dt * columns


def jacobian(model: BatchModel, r: int, theta: Tensor, x: Tensor) -> Tensor:
    """Return J = ∂a/∂θ, (n, N, r, q), of r accelerations for parameters (n, q) at (n, N, d)."""
    (n, N), q = x.shape[:2], theta.shape[1]
    with torch.enable_grad():
        each = theta.detach()[:, None, None].expand(n, N, r, q).reshape(-1, q).requires_grad_()
        values = model(each, x.unsqueeze(2).expand(n, N, r, -1).reshape(len(each), 1, -1))
        total = values.view(-1, r, r).diagonal(dim1=1, dim2=2).sum()
        (J,) = torch.autograd.grad(total, each, materialize_grads=True)
    return J.view(n, N, r, q)


def gradients_and_changes(
    model: BatchModel, theta: Tensor, x: Tensor, components: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """Return g = ∂a_k/∂θ, and its derivative along a direction of the state, (n, q) each.

    The derivative of g along b is the gradient, with respect to θ, of bᵀ ∂a_k/∂x.

    Parameters
    ----------
    theta : (n, q)
    x, directions : (n, d)
    components : (n,)
        The output k of each item.
    """
    with torch.enable_grad():
        each, at = theta.detach().requires_grad_(), x.detach().requires_grad_()
        chosen = model(each, at.unsqueeze(1)).squeeze(1).gather(1, components.unsqueeze(1))
        g, slope = torch.autograd.grad(
            chosen.sum(), (each, at), create_graph=True, materialize_grads=True
        )
        along = (slope * directions).sum()
        if not along.requires_grad:  # the slope does not depend on θ
            return g.detach(), torch.zeros_like(g)
        (change,) = torch.autograd.grad(along, each, materialize_grads=True)
    return g.detach(), change


@dataclass(frozen=True, kw_only=True)
class Module(Model):
    """a_θ(x) = network(features of x), for a subclass of ``torch.nn.Module`` with parameters θ.

    The class is called with the numbers p of features and r of learned accelerations and with the
    entries of its section by keyword. Its ``forward`` maps features, (p,), to accelerations, (r,),
    in double precision, in evaluation mode, and differentiably by ``torch.func``. θ holds all its
    parameters in the order of ``named_parameters()``. Its own initialisation, from a torch
    generator that the trial seeds, gives the initial ones.

    Parameters
    ----------
    target : str
        Dotted path of the class.
    source : str
        Digest of the file that defines it.
    arguments : str
        Canonical JSON of the keyword arguments.
    """

    compiled: ClassVar[bool] = False

    target: str
    source: str
    arguments: str = "{}"

    @property
    def name(self) -> str:  # type: ignore[override]  # the class that is wrapped has the name
        return self.target.rpartition(".")[2]

    @classmethod
    def from_section(cls, given: Mapping[str, object]) -> Module:
        """Return the model that a configuration section with a ``_target_`` describes.

        Raises
        ------
        SpecificationError
            If the class is not a network, was stored in another state of its file, or an argument
            is nothing that JSON knows.
        """
        target = str(given[TARGET])
        network = imported("model", target, given)
        if not (isinstance(network, type) and issubclass(network, nn.Module)):
            raise SpecificationError(
                f"model.{TARGET} is '{target}', but a class derived from torch.nn.Module is "
                f"expected: correct the class or the path."
            )
        check_source("model", target, network, given)
        model = cls(target=target, source=source_digest(network), arguments=_canonical(given))
        if given.get("name", model.name) != model.name:
            raise SpecificationError(
                f"model.name is '{given['name']}', but {target} is called '{model.name}': leave "
                f"model.name out, or correct it."
            )
        return model

    def to_section(self) -> dict[str, object]:
        """Return the section from which :meth:`from_section` makes this model."""
        origin = {TARGET: self.target, SOURCE: self.source}
        return {"name": self.name, **origin, **json.loads(self.arguments)}

    @property
    def _class(self) -> type[nn.Module]:
        given = {SOURCE: self.source}
        found: Any = imported("model", self.target, given)
        network: type[nn.Module] = found
        check_source("model", self.target, network, given)
        return network

    def module(self, system: System) -> nn.Module:
        """Return the network for a system, with parameters that nobody should rely on."""
        return _network(self, len(system.features), system.n_learned)

    def n_parameters(self, system: System) -> int:
        return sum(parameter.numel() for parameter in self.module(system).parameters())

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        seed = int(rng.integers(2**63 - 1))
        drawn = _built(self, len(system.features), system.n_learned, seed)
        return _array(parameters_to_vector(drawn.parameters()))

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        function = network_function(system, self.module(system))
        theta, states = torch.as_tensor(parameters), torch.as_tensor(points)
        with torch.no_grad():
            return _array(function(theta[None], states[None])[0])


def _canonical(given: Mapping[str, object]) -> str:
    arguments = {k: v for k, v in given.items() if k not in ("name", TARGET, SOURCE)}
    try:
        return json.dumps(arguments, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SpecificationError(
            f"the arguments of model.{TARGET} are {arguments!r}, but finite numbers, texts and "
            f"lists of them are expected ({error}): change these arguments."
        ) from error


@functools.lru_cache(maxsize=16)
def _network(model: Module, n_features: int, n_outputs: int) -> nn.Module:
    """Return a network that has been tried out."""
    module = _built(model, n_features, n_outputs, 0)
    try:
        out = module(torch.zeros(n_features, dtype=torch.float64))
    except Exception as error:
        raise _wrong(model, f"maps {n_features} features to accelerations", error) from error
    if not isinstance(out, torch.Tensor) or out.shape != (n_outputs,):
        shape = tuple(out.shape) if isinstance(out, torch.Tensor) else type(out).__name__
        raise _wrong(model, f"maps {n_features} features to shape ({n_outputs},)", shape)
    if not any(parameter.numel() for parameter in module.parameters()):
        raise _wrong(model, "has parameters", "none")
    return module


def _built(model: Module, n_features: int, n_outputs: int, seed: int) -> nn.Module:
    """Return a new network in double precision; torch's own generator is left as it was."""
    arguments = json.loads(model.arguments)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            module = model._class(n_features, n_outputs, **arguments)
        except Exception as error:
            expected = f"takes {n_features} features, {n_outputs} outputs and {arguments}"
            raise _wrong(model, expected, error) from error
    return module.double().eval()


def _array(values: torch.Tensor) -> Array:
    array: Array = values.detach().numpy().astype(np.float64)
    return array


def _wrong(model: Module, expected: str, given: object) -> SpecificationError:
    return SpecificationError(
        f"model.{TARGET} is '{model.target}', but a network that {expected} is expected, and it "
        f"gave: {given}; correct the class or its arguments."
    )
