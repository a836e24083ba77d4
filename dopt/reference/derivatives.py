"""Derivatives of a model with respect to its parameters and its points, by reverse differentiation.

All items are differentiated together: each has parameters of its own, so that the gradient of a sum
over the items holds the gradient of each.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from dopt.reference.models import BatchModel


def rows(
    model: BatchModel, r: int, theta: Tensor, points: Tensor, *, differentiable: bool = False
) -> Tensor:
    """Return J = ∂a/∂θ, (n, N, r, q), of r accelerations for parameters (n, q) at (n, N, ·).

    ``differentiable`` rows can be differentiated with respect to the points.
    """
    (n, N), q = points.shape[:2], theta.shape[1]
    with torch.enable_grad():
        each = theta.detach()[:, None, None].expand(n, N, r, q).reshape(-1, q).requires_grad_()
        values = model(each, points.unsqueeze(2).expand(n, N, r, -1).reshape(len(each), 1, -1))
        total = values.view(-1, r, r).diagonal(dim1=1, dim2=2).sum()
        (J,) = torch.autograd.grad(total, each, create_graph=differentiable, materialize_grads=True)
    return J.view(n, N, r, q)


def gradients_and_changes(
    model: BatchModel, theta: Tensor, points: Tensor, components: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """Return g = ∂a_k/∂θ, and its derivative along a direction of the point, (n, q) each.

    The derivative of g along b is the gradient, with respect to θ, of bᵀ ∂a_k/∂x.

    Parameters
    ----------
    theta : (n, q)
    points, directions : (n, ·)
    components : (n,)
        The output k of each item.
    """
    with torch.enable_grad():
        each, at = theta.detach().requires_grad_(), points.detach().requires_grad_()
        chosen = model(each, at.unsqueeze(1)).squeeze(1).gather(1, components.unsqueeze(1))
        g, slope = torch.autograd.grad(
            chosen.sum(), (each, at), create_graph=True, materialize_grads=True
        )
        along = (slope * directions).sum()
        if not along.requires_grad:  # the slope does not depend on θ
            return g.detach(), torch.zeros_like(g)
        (change,) = torch.autograd.grad(along, each, materialize_grads=True)
    return g.detach(), change


def jacobian(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Return ∂y/∂x, (n, k, d), of a function from (n, d) to (n, k) that takes each row alone."""
    with torch.enable_grad():
        at = x.detach().requires_grad_()
        y = function(at)
        columns = [
            torch.autograd.grad(part.sum(), at, retain_graph=True, materialize_grads=True)[0]
            for part in y.unbind(1)
        ]
    return torch.stack(columns, dim=1)
