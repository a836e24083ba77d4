"""Models, dynamics and equations (5) to (7) over tensors, for a batch of trials; torch networks.

======  ==================================================  =========
symbol  meaning (Proposition 1)                             shape
======  ==================================================  =========
x̄       predicted state x_t + dt f_θ(x_t, 0)                d
B       dt ∂known/∂u at x̄                                   d × m
g       ∂a_θ^k/∂θ at x̄                                      q
D B     derivative of g along the columns of B              q × m
M       information matrix                                  q × q
J       rows that a sample adds: M grows by JᵀJ             r × q
======  ==================================================  =========

All items of a derivative are taken together: each has parameters of its own, so that the gradient
of a sum over the items holds the gradient of each. The maximum on the sphere is found as in
:mod:`dopt.sphere`, in another form: the root of the secular equation is enclosed for all problems
at once, in intervals of which each is a part of the one before.
"""

from __future__ import annotations

import functools
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.nn.utils import parameters_to_vector

from dopt.algorithm import TIE_MARGIN
from dopt.errors import SpecificationError
from dopt.models import MLP, Linear, Model
from dopt.policies.d_optimal import best_on_sphere
from dopt.registry import SOURCE, TARGET, check_source, imported, source_digest
from dopt.systems.base import System, feature_values, next_state
from dopt.types import Array, Scalar


class BatchModel(ABC):
    """a_θ of n trials: parameters (n, q) and states (n, N, d) to accelerations (n, N, r).

    States that are the same for all trials may have 1 in the place of n.
    """

    def __init__(self, system: System) -> None:
        self._system = system

    def __call__(self, theta: Tensor, x: Tensor) -> Tensor:
        return self.at(theta, self.points(x))

    def points(self, x: Tensor) -> Tensor:
        """Return what the model is a function of: the features, (..., p), of states (..., d)."""
        values = feature_values(self._system.features, self._system.feature_scales, x.unbind(-1))
        return torch.stack(values, dim=-1)

    @abstractmethod
    def at(self, theta: Tensor, points: Tensor) -> Tensor:
        """Return a_θ, (n, N, r), for parameters (n, q) at :meth:`points`, (n or 1, N, ·)."""

    def leaves(self, theta: Tensor) -> tuple[Tensor, Sequence[Tensor]]:
        """Return parameters (n, q) to call the model with, and what to differentiate by."""
        at = theta.detach().requires_grad_()
        return at, [at]


def model_function(system: System, model: Model, device: str = "cpu") -> BatchModel:
    """Return a_θ of a model: a network, or the linear form of physics."""
    if isinstance(model, MLP):
        return MLPFunction(system, model)
    if isinstance(model, Linear):
        return LinearFunction(system)
    if isinstance(model, Module):
        return NetworkFunction(system, model.module(system).to(device))
    raise TypeError(f"model {model!r} is no network and not linear: run it in the kernel.")


class MLPFunction(BatchModel):
    """Layers with tanh between them; each has its matrix, outputs by inputs, and biases."""

    def __init__(self, system: System, model: MLP) -> None:
        super().__init__(system)
        sizes = model.layer_inputs(system), model.layer_sizes(system)[1:]
        self._shapes = list(zip(*sizes, strict=True))
        self._lengths = [n for n_in, n_out in self._shapes for n in (n_in * n_out, n_out)]

    def at(self, theta: Tensor, points: Tensor) -> Tensor:
        parts = iter(theta.split(self._lengths, dim=1))
        h = points.expand(len(theta), -1, -1)
        for layer, (n_in, n_out) in enumerate(self._shapes):
            W, b = next(parts).unflatten(1, (n_out, n_in)).mT, next(parts).unsqueeze(1)
            h = torch.baddbmm(b, h.tanh() if layer else h, W)
        return h


class LinearFunction(BatchModel):
    """The offset and Ψ θ, in the system's ``linear_parameters``."""

    def points(self, x: Tensor) -> Tensor:
        """Return the offset and Ψ, (..., r, 1 + q), at states (..., d)."""
        system, states = self._system, x.unbind(-1)
        offset, *units = (stack(system.accelerations(states, p)) for p in system.linear_form)
        return torch.stack([offset, *(unit - offset for unit in units)], dim=-1)

    def at(self, theta: Tensor, points: Tensor) -> Tensor:
        return points[..., 0] + (points[..., 1:] @ theta[:, None, :, None]).squeeze(-1)


class NetworkFunction(BatchModel):
    """a_θ for any module that maps the features, (p,), to accelerations, (r,).

    The flat vector holds the module's parameters in the order of ``module.parameters()``. A module
    that gives the same for many points at once, (N, p), is called once for them. The module belongs
    to the function, which writes θ of one trial into its parameters and differentiates by these: it
    costs less than other tensors in their places, which a batch of trials needs.
    """

    def __init__(self, system: System, module: nn.Module) -> None:
        super().__init__(system)
        self._module, self.parameters = module, [*module.parameters()]
        self._names = [name for name, _ in module.named_parameters()]
        self._lengths = [parameter.numel() for parameter in self.parameters]
        self._theta = parameters_to_vector(self.parameters).detach()
        for own, part in zip(self.parameters, self._theta.split(self._lengths), strict=True):
            own.data = part.view_as(own)
            own.requires_grad_()  # all are learned
        self._units = torch.eye(system.n_learned).to(self._theta).unbind()
        self._at_once: bool | None = None  # known once the module has been tried
        self._one_by_one = vmap(module)
        self._over_trials = vmap(self._network)
        self._over_both = vmap(vmap(self._network, in_dims=(None, 0)))

    def at(self, theta: Tensor, points: Tensor) -> Tensor:
        n, N = len(theta), points.shape[1]
        if n == 1 and not (theta.requires_grad or points.requires_grad):
            self._theta.copy_(theta[0])
            out = self._module(points[0, 0]) if N == 1 else self._of_many(points[0])
        else:
            points = points.expand(n, -1, -1)
            many = self._over_both if N > 1 else self._over_trials
            out = many(theta, points if N > 1 else points[:, 0])
        values: Tensor = out.view(n, N, -1)
        return values

    def leaves(self, theta: Tensor) -> tuple[Tensor, Sequence[Tensor]]:
        return (theta, self.parameters) if len(theta) == 1 else super().leaves(theta)

    def value(self, theta: Tensor, phi: Tensor) -> Tensor:
        """Return a_θ, (r,), for parameters (q,) at the features of a state, (p,)."""
        self._theta.copy_(theta)
        value: Tensor = self._module(phi)
        return value

    def jacobian(self, theta: Tensor, phi: Tensor) -> Tensor:
        """Return ∂a/∂θ, (r, q), for parameters (q,) at the features of a state, (p,).

        A pass backward for each row costs less than one for a batch of copies.
        """
        self._theta.copy_(theta)
        with torch.enable_grad():
            return _rows(self._module(phi), self.parameters, self._units)

    def gradient_and_changes(
        self, theta: Tensor, phi: Tensor, component: int, directions: Tensor
    ) -> Tensor:
        """Return g and its derivatives along directions of the features, (m, p): (1 + m, q)."""
        self._theta.copy_(theta)
        with torch.enable_grad():
            phi = phi.requires_grad_()
            *g, slope = torch.autograd.grad(
                self._module(phi),
                (*self.parameters, phi),
                self._units[component],
                create_graph=True,
                materialize_grads=True,
            )
            changes = _rows(slope, self.parameters, directions.unbind())
        return torch.cat([flat(g).detach()[None], changes])

    def _network(self, theta: Tensor, phi: Tensor) -> Tensor:
        parts = zip(theta.split(self._lengths), self.parameters, strict=True)
        weights = [part.view(own.shape) for part, own in parts]
        out: Tensor = functional_call(
            self._module, dict(zip(self._names, weights, strict=True)), phi
        )
        return out

    def _of_many(self, phi: Tensor) -> Tensor:
        if self._at_once is None:
            self._at_once = _maps_many(self._module, phi, self._one_by_one(phi))
        out: Tensor = self._module(phi) if self._at_once else self._one_by_one(phi)
        return out


def _rows(values: Tensor, leaves: Sequence[Tensor], directions: Sequence[Tensor]) -> Tensor:
    """Return the gradients of values, (n,), along k directions, by leaves of q numbers: (k, q)."""
    if not values.requires_grad:  # they do not depend on them
        return values.new_zeros(len(directions), sum(map(Tensor.numel, leaves)))
    rows = [
        torch.autograd.grad(values, leaves, along, retain_graph=True, materialize_grads=True)
        for along in directions
    ]
    return flat([part for row in rows for part in row]).view(len(directions), -1)


def flat(parts: Sequence[Tensor]) -> Tensor:
    """Return all entries of tensors, one after the other."""
    return torch.cat([part.flatten() for part in parts])


def _maps_many(module: nn.Module, phi: Tensor, expected: Tensor) -> bool:
    """Return whether a module maps points, (N, p), to what it maps them to one by one."""
    with torch.no_grad():
        try:
            return torch.allclose(module(phi), expected, rtol=1e-12, atol=1e-13)
        except (RuntimeError, IndexError, TypeError, ValueError):  # a user's module
            return False


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


def jacobian(model: BatchModel, r: int, theta: Tensor, points: Tensor) -> Tensor:
    """Return J = ∂a/∂θ, (n, N, r, q), of r accelerations for parameters (n, q) at (n, N, ·)."""
    (n, N, *shape), q = points.shape, theta.shape[1]
    if n * N == 1 and isinstance(model, NetworkFunction):
        return model.jacobian(theta[0], points[0, 0]).view(1, 1, r, q)
    with torch.enable_grad():
        each = theta.detach()[:, None, None].expand(n, N, r, q).reshape(-1, q).requires_grad_()
        at = points.unsqueeze(2).expand(n, N, r, *shape).reshape(len(each), 1, *shape)
        total = model.at(each, at).view(-1, r, r).diagonal(dim1=1, dim2=2).sum()
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
        check_source("model", target, network, given, target.rpartition(".")[2])
        return cls(target=target, source=source_digest(network), arguments=_canonical(given))

    def to_section(self) -> dict[str, object]:
        """Return the section from which :meth:`from_section` makes this model."""
        origin = {TARGET: self.target, SOURCE: self.source}
        return {"name": self.name, **origin, **json.loads(self.arguments)}

    @property
    def _class(self) -> type[nn.Module]:
        given = {SOURCE: self.source}
        found: Any = imported("model", self.target, given)
        network: type[nn.Module] = found
        check_source("model", self.target, network, given, self.name)
        return network

    def module(self, system: System) -> nn.Module:
        """Return a new network for a system, with parameters that nobody should rely on."""
        sizes = len(system.features), system.n_learned
        _n_parameters(self, *sizes)
        return _built(self, *sizes, 0)

    def n_parameters(self, system: System) -> int:
        return _n_parameters(self, len(system.features), system.n_learned)

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        seed = int(rng.integers(2**63 - 1))
        drawn = _built(self, len(system.features), system.n_learned, seed)
        return _array(parameters_to_vector(drawn.parameters()))

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        theta, states = torch.as_tensor(parameters), torch.as_tensor(points)
        with torch.no_grad():
            return _array(_function(self, system)(theta[None], states[None])[0])


@functools.lru_cache(maxsize=16)
def _function(model: Module, system: System) -> NetworkFunction:
    return NetworkFunction(system, model.module(system))


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
def _n_parameters(model: Module, n_features: int, n_outputs: int) -> int:
    """Return the number of parameters of a network, which is tried out."""
    module = _built(model, n_features, n_outputs, 0)
    try:
        out = module(torch.zeros(n_features, dtype=torch.float64))
    except Exception as error:
        raise _wrong(model, f"maps {n_features} features to accelerations", error) from error
    if not isinstance(out, torch.Tensor) or out.shape != (n_outputs,):
        shape = tuple(out.shape) if isinstance(out, torch.Tensor) else type(out).__name__
        raise _wrong(model, f"maps {n_features} features to shape ({n_outputs},)", shape)
    count = sum(parameter.numel() for parameter in module.parameters())
    if not count:
        raise _wrong(model, "has parameters", "none")
    return count


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
    return values.detach().numpy().astype(np.float64)


def _wrong(model: Module, expected: str, given: object) -> SpecificationError:
    return SpecificationError(
        f"model.{TARGET} is '{model.target}', but a network that {expected} is expected, and it "
        f"gave: {given}; correct the class or its arguments."
    )


SMALL = 100
"""Largest size of an M that is factorised afresh after each step; of a larger one M⁻¹ is held."""

PARTS = 64
DIVISIONS = 11
TINY = 1e-150
ROUNDING = 4e-16


class BatchInformation:
    """M of n trials, (n, s, s), λI at the beginning, which grows by rows.

    A trial for which rounding has left M indefinite has NaN in its solutions.
    """

    def __init__(self, regularization: float, like: Tensor) -> None:
        n, s = like.shape
        self._is_small, identity = s <= SMALL, torch.eye(s).to(like).repeat(n, 1, 1)
        self._held = identity * (regularization if self._is_small else 1.0 / regularization)

    def add(self, J: Tensor) -> None:
        """Add JᵀJ for rows (n, r, s)."""
        if self._is_small:
            self._held = self._held + J.mT @ J
            return
        along = self._held @ J.mT
        factor = cholesky_factor(torch.eye(J.shape[1]).to(J) + J @ along)
        roots = torch.linalg.solve_triangular(factor, along.mT, upper=False)
        self._held.baddbmm_(roots.mT, roots, alpha=-1)

    def solve(self, columns: Tensor) -> Tensor:
        """Return M⁻¹ C, (n, s, c), for columns C (n, s, c)."""
        if not self._is_small:
            return self._held @ columns
        return torch.cholesky_solve(columns, cholesky_factor(self._held))


class TrialInformation(BatchInformation):
    """The same for one trial on this processor: numpy is faster with a few columns."""

    def add(self, J: Tensor) -> None:
        if self._is_small:
            return super().add(J)
        held, rows = self._held[0], J[0].numpy()
        along = held.numpy() @ rows.T
        try:
            factor = np.linalg.cholesky(np.eye(len(rows)) + rows @ along)
        except np.linalg.LinAlgError:
            factor = np.full((len(rows), len(rows)), np.nan)
        roots = torch.from_numpy(np.linalg.solve(factor, along.T))
        held.addmm_(roots.mT, roots, alpha=-1)
        return None

    def solve(self, columns: Tensor) -> Tensor:
        if self._is_small:
            return super().solve(columns)
        return torch.from_numpy(self._held[0].numpy() @ columns[0].numpy())[None]


def cholesky_factor(matrix: Tensor) -> Tensor:
    """Return the lower Cholesky factors of matrices, (n, s, s); NaN where one is indefinite."""
    factor, failed = torch.linalg.cholesky_ex(matrix)
    return torch.where((failed > 0)[:, None, None], torch.nan, factor)


def predicted_states(system: System, model: BatchModel, theta: Tensor, x: Tensor) -> Tensor:
    """Return x̄ of every trial, (n, d), for parameters (n, q) and states (n, d)."""
    zero = torch.zeros(len(x), system.n_inputs, dtype=x.dtype, device=x.device)
    return model_states(system, model, theta, x, zero, system.dt)


def planning_columns(
    system: System, model: BatchModel, theta: Tensor, x: Tensor, components: Tensor
) -> Tensor:
    """Return g and the columns of D B as rows, (n, 1 + m, q), for components (n,)."""
    bar = predicted_states(system, model, theta, x).detach()
    B = input_matrix(system, bar)
    n, m = len(x), B.shape[2]
    g, DB = gradients_and_changes(
        model,
        theta.repeat_interleave(m, dim=0),
        bar.repeat_interleave(m, dim=0),
        components.repeat_interleave(m, dim=0),
        B.mT.flatten(0, 1),
    )
    return torch.cat([g.view(n, m, -1)[:, :1], DB.view(n, m, -1)], dim=1)


QuadraticProblem = tuple[Tensor, Tensor]
"""Q, (n, m, m), and v, (n, m), of equation 7: maximise uᵀQu - 2vᵀu on the sphere."""


def quadratic_problem(columns: Tensor, information: BatchInformation) -> QuadraticProblem:
    """Return Q and v from the :func:`planning_columns`, (n, 1 + m, s)."""
    forms = columns @ information.solve(columns.mT)
    return forms[:, 1:, 1:], -forms[:, 1:, 0]


def d_optimal_inputs(problem: QuadraticProblem, gamma: float, ties: Tensor) -> Tensor:
    """Return the maximisers, (n, m); ``ties`` (n, m) decide between equal ones.

    A problem that is not finite has none: its input is NaN, and the trial diverges.
    """
    Q, v = problem
    if len(v) == 1:
        Q_0, v_0, tie = (one[0].numpy(force=True) for one in (Q, v, ties))
        return v.new_tensor(best_on_sphere(Q_0, v_0, tie, gamma))[None]
    finite = torch.cat([Q, v.unsqueeze(-1)], dim=-1).isfinite().all(-1).all(-1, keepdim=True)
    if v.shape[1] == 1:
        up = (v < 0) | ((v == 0) & (ties > 0))
        chosen = torch.where(up, gamma, -gamma).to(v)
    else:
        Q, v = torch.where(finite.unsqueeze(-1), Q, 0.0), torch.where(finite, v, 0.0)
        chosen = maximize_on_spheres(Q, v, gamma, ties)
    return torch.where(finite, chosen, torch.nan)


def uniform_inputs(
    system: System, model: BatchModel, theta: Tensor, states: Tensor, steps: int
) -> Tensor:
    """Return the inputs, (n, m), that lead farthest from all states seen, (n, t + 1, d).

    Gradient ascent on the sphere from ±γ along every input axis, by automatic differentiation.
    """
    x = states[:, -1]
    center = predicted_states(system, model, theta, x).unsqueeze(1)
    B = input_matrix(system, x)
    axes = torch.eye(system.n_inputs, dtype=x.dtype, device=x.device)
    starts = system.gamma * torch.stack([axes, -axes], dim=1).flatten(0, 1)

    def distances(u: Tensor) -> Tensor:
        reached = (center + u @ B.mT).unsqueeze(2)
        apart: Tensor = torch.linalg.vector_norm(reached - states.unsqueeze(1), dim=-1)
        return apart.sum(dim=-1)

    u = starts.expand(len(x), -1, -1)
    for _ in range(steps if system.n_inputs > 1 else 0):
        with torch.enable_grad():
            u = u.detach().requires_grad_()
            (slope,) = torch.autograd.grad(distances(u).sum(), u)
        u = system.gamma * slope / torch.linalg.vector_norm(slope, dim=-1, keepdim=True)
    value = distances(u)
    best, best_value = u[:, 0], value[:, 0]
    for i in range(1, len(starts)):
        better = value[:, i] > best_value * (1 + TIE_MARGIN)
        best = torch.where(better.unsqueeze(-1), u[:, i], best)
        best_value = torch.where(better, value[:, i], best_value)
    return best


def maximize_on_spheres(Q: Tensor, v: Tensor, radius: float, ties: Tensor) -> Tensor:
    """Return maximisers, (n, m), of uᵀQu - 2vᵀu on ‖u‖ = radius.

    Parameters
    ----------
    Q : (n, m, m)
        Quadratic terms; the symmetric parts count.
    v : (n, m)
        Linear terms.
    radius : float
        γ > 0.
    ties : (n, m)
        Directions that decide between maximisers of equal value.
    """
    Q, v = _without_overflow(Q, v)
    scale = torch.maximum(radius * Q.abs().amax((1, 2)), v.abs().amax(1))
    flat, scale = (scale == 0)[:, None], scale.clamp_min(1e-300)
    A = (Q + Q.mT) * (0.5 * radius / scale)[:, None, None]
    values, axes = torch.linalg.eigh(A)
    w = (axes.mT @ (v / scale[:, None]).unsqueeze(-1)).squeeze(-1)
    preferred = (axes.mT @ ties.unsqueeze(-1)).squeeze(-1)
    gaps = values[:, -1:] - values
    top = gaps <= ROUNDING * values.shape[1] * values.abs().amax(1, keepdim=True)
    gaps = torch.where(top, torch.zeros_like(gaps), gaps)

    s = _secular_root(w, gaps, top)
    unit = -w / (gaps + s).clamp_min(1e-300)
    below = torch.where(top, torch.zeros_like(w), -w / torch.where(top, torch.ones_like(w), gaps))
    missing = 1 - below.square().sum(1, keepdim=True)
    along = torch.where(top, preferred, torch.zeros_like(preferred))
    along = _direction(along, axis=-1)
    hard = (torch.where(top, w, torch.zeros_like(w)).abs().amax(1, keepdim=True) < TINY) & (
        missing >= 0
    )
    unit = torch.where(hard, below + along * missing.clamp_min(0).sqrt(), unit)
    u = (axes @ unit.unsqueeze(-1)).squeeze(-1)
    u = torch.where(flat, _direction(ties, axis=0), u)
    scaled: Tensor = u * (radius / torch.linalg.vector_norm(u, dim=1, keepdim=True))
    return scaled


def _without_overflow(Q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Return both divided by a power of two, which is exact: the largest entry is 1 to 2."""
    largest = torch.maximum(Q.abs().amax((1, 2)), v.abs().amax(1))
    unit = torch.ldexp(torch.ones_like(largest), torch.frexp(largest).exponent - 1)
    unit = torch.where(largest > 0, unit, torch.ones_like(unit))
    return Q / unit[:, None, None], v / unit[:, None]


def _direction(vectors: Tensor, axis: int) -> Tensor:
    """Return vectors, (n, m), of norm 1; along an axis where they are zero."""
    length = torch.linalg.vector_norm(vectors, dim=1, keepdim=True)
    along_axis = torch.zeros_like(vectors)
    along_axis[:, axis] = 1.0
    return torch.where(length > TINY, vectors / length.clamp_min(TINY), along_axis)


def _secular_root(w: Tensor, gaps: Tensor, top: Tensor) -> Tensor:
    """Return s ≥ 0 with ‖w / (gaps + s)‖ = 1, (n, 1), by division of its logarithm's range."""
    low = torch.where(top, w, torch.zeros_like(w)).square().sum(1, keepdim=True).sqrt()
    low = low.clamp_min(TINY).log()
    high = torch.linalg.vector_norm(w, dim=1, keepdim=True).clamp_min(TINY).log()
    high = torch.maximum(low, high)
    shares = torch.linspace(0.0, 1.0, PARTS + 1).to(w)
    for _ in range(DIVISIONS):
        tried = low + (high - low) * shares
        squares = (w.unsqueeze(2) / (gaps.unsqueeze(2) + tried.exp().unsqueeze(1))).square()
        outside = (squares.sum(1) >= 1).sum(1, keepdim=True)
        part = (outside - 1).clamp(0, PARTS - 1)
        low, high = tried.gather(1, part), tried.gather(1, part + 1)
    return (0.5 * (low + high)).exp()
