"""The quadratic problem on a sphere for a batch, in torch: see :mod:`dopt.sphere`.

The same mathematics in another form: the root of the secular equation is enclosed for all problems
at once, in intervals of which each is a part of the one before.
"""

from __future__ import annotations

import torch
from torch import Tensor

PARTS = 64
DIVISIONS = 11
TINY = 1e-150
ROUNDING = 4e-16


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
