"""Random parameters, states and information for a model of the reference."""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from dopt.randomness import draw
from dopt.reference.models import BatchModel, model_function
from dopt.spec.trial import TrialSpec
from tests.dopt.custom_networks import for_one


class Situation(NamedTuple):
    """What a plan is made from, for one trial."""

    model: BatchModel
    theta: Tensor  # (q,)
    state: Tensor  # (d,)
    information: Tensor  # (q, q)


@functools.cache
def situation(
    spec: TrialSpec, seed: int, seen: int = 20, regularization: float = 1e-2
) -> Situation:
    """Return a situation after some states have been seen, for the model of a trial."""
    rng = torch.Generator().manual_seed(seed)
    system = spec.system
    model = model_function(system, spec.model)
    theta = torch.tensor(draw(spec.with_seed(seed)).weights)
    theta = theta + 0.1 * torch.rand(theta.shape, generator=rng, dtype=torch.float64)
    widths = torch.ones(system.n_states, dtype=torch.float64)
    widths[list(system.grid_indices)] = torch.tensor(system.grid_half_widths, dtype=torch.float64)
    states = widths * (2 * torch.rand(seen + 1, system.n_states, generator=rng).double() - 1)
    M = regularization * torch.eye(len(theta), dtype=torch.float64)
    if seen:
        J = vmap(jacrev(for_one(model)), (None, 0))(theta, states[1:]).flatten(0, 1)
        M = M + J.mT @ J
    return Situation(model, theta, states[0], M)


def step_from(spec: TrialSpec, now: Situation, u: Tensor) -> Tensor:
    """Return x(u) = x + dt f_θ(x, u), by the system's own equations, (d,)."""
    system = spec.system
    known = system.known(tuple(now.state), tuple(u), system.parameters)
    flow = torch.stack([torch.as_tensor(value, dtype=torch.float64) for value in known])
    rows = torch.zeros(system.n_states, system.n_learned, dtype=torch.float64)
    for k, row in enumerate(system.learned_rows):
        rows[row, k] = 1.0
    return now.state + system.dt * (flow + rows @ for_one(now.model)(now.theta, now.state))


def circle(radius: float, points: int) -> Tensor:
    """Return points on a circle, (points, 2)."""
    angles = torch.arange(points, dtype=torch.float64) * (2 * torch.pi / points)
    return radius * torch.stack([angles.cos(), angles.sin()], dim=-1)


def sphere(radius: float, dimensions: int) -> Tensor:
    """Return points on a sphere, (points, dimensions): both, evenly spread, or random ones."""
    if dimensions == 1:
        return torch.tensor([[radius], [-radius]], dtype=torch.float64)
    if dimensions == 2:
        return circle(radius, 3_600)
    rng = torch.Generator().manual_seed(0)
    points = torch.randn(20_000, dimensions, generator=rng, dtype=torch.float64)
    return radius * points / points.norm(dim=1, keepdim=True)
