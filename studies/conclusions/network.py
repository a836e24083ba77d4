"""The network once more: a linear part, prior variances of its layers by evidence, cold restarts.

The accelerations are a(x) = A φ + W₃ tanh(W₂ tanh(W₁ φ + b₁) + b₂) + b₃. Every matrix and bias is a
group of parameters with a normal prior of its own precision; noise is known. With all parameters at
their most probable values the precisions follow from the evidence of Laplace's approximation, in
turns. Reference: D. MacKay, "A practical Bayesian framework for backpropagation networks", Neural
Computation 4 (1992).

======  =====================================================  =====
symbol  meaning                                                shape
======  =====================================================  =====
θ       all parameters                                         q
J       Jacobian of all accelerations                          N r × q
α       precision of the prior of each parameter               q
H       JᵀJ/ν + diag α                                         q × q
γ       1 - α (H⁻¹)_ii summed over a group: what it determines
======  =====================================================  =====
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from dopt.types import Array

WIDTH = 16
ROUNDS = 25
STEPS = 12
"""Gauss-Newton steps between two estimates of the precisions."""


class Fit(NamedTuple):
    """A fitted network and the logarithm of its evidence, up to a constant of the samples."""

    parameters: Array  # (q,)
    evidence: float


class LinearAndTanh:
    """The network for p features and r accelerations."""

    def __init__(self, p: int, r: int, width: int = WIDTH) -> None:
        w = width
        self.shapes = [(r, p), (w, p), (w,), (w, w), (w,), (r, w), (r,)]
        sizes = [int(np.prod(shape)) for shape in self.shapes]
        self.ends = np.cumsum(sizes)
        self.groups = np.repeat(np.arange(len(sizes)), sizes)

    def initial(self, rng: np.random.Generator) -> Array:
        """Draw parameters, (q,)."""
        parts = [
            rng.standard_normal(shape).ravel() / np.sqrt(shape[-1]) for shape in self.shapes
        ]
        parts[0] *= 0.0
        return np.concatenate(parts)

    def parts(self, theta: Array) -> list[Array]:
        """Return views of the matrices and biases."""
        split = np.split(theta, self.ends[:-1])
        return [part.reshape(shape) for part, shape in zip(split, self.shapes, strict=True)]

    def predict(self, theta: Array, phi: Array) -> Array:
        """Return accelerations, (N, r), at features, (N, p)."""
        A, W1, b1, W2, b2, W3, b3 = self.parts(theta)
        hidden = np.tanh(np.tanh(phi @ W1.T + b1) @ W2.T + b2)
        values: Array = phi @ A.T + hidden @ W3.T + b3
        return values

    def jacobian(self, theta: Array, phi: Array) -> tuple[Array, Array]:
        """Return accelerations, (N, r), and J, (N r, q)."""
        A, W1, b1, W2, b2, W3, b3 = self.parts(theta)
        N, r = len(phi), len(b3)
        h1 = np.tanh(phi @ W1.T + b1)
        h2 = np.tanh(h1 @ W2.T + b2)
        values = phi @ A.T + h2 @ W3.T + b3
        d2 = W3[None] * (1.0 - h2**2)[:, None]  # (N, r, w)
        d1 = (d2 @ W2) * (1.0 - h1**2)[:, None]
        own = np.broadcast_to(np.eye(r), (N, r, r))
        blocks = [
            own[..., None] * phi[:, None, None],
            d1[..., None] * phi[:, None, None],
            d1,
            d2[..., None] * h1[:, None, None],
            d2,
            own[..., None] * h2[:, None, None],
            own,
        ]
        return values, np.concatenate([one.reshape(N * r, -1) for one in blocks], axis=1)


def fit(phi: Array, targets: Array, noise: float, rng: np.random.Generator) -> Fit:
    """Fit the network to features (N, p) and accelerations (N, r) with a variance of the noise."""
    network = LinearAndTanh(phi.shape[1], targets.shape[1])
    theta, groups = network.initial(rng), network.groups
    alpha = np.ones(len(network.shapes))
    size = float(np.mean(targets**2)) or 1.0
    alpha[[0, 5, 6]] = 1.0 / size
    nu, evidence = max(noise, 1e-3 * size), -np.inf
    for turn in range(ROUNDS):
        nu = max(noise, nu * 0.5)  # from a rough fit to one as fine as the noise
        theta = _most_probable(network, theta, phi, targets, nu, alpha[groups])
        values, J = network.jacobian(theta, phi)
        errors = (targets - values).ravel()
        H = J.T @ J / nu + np.diag(alpha[groups])
        factor = cho_factor(H, lower=True)
        variances = np.diag(cho_solve(factor, np.eye(len(theta))))
        cost = errors @ errors / nu + alpha[groups] @ theta**2
        priors = np.log(alpha[groups]).sum()
        whole = 2.0 * np.log(np.diag(factor[0])).sum() + len(errors) * np.log(nu)
        evidence = 0.5 * float(priors - cost - whole)
        if turn == ROUNDS - 1:
            break
        for g in range(len(alpha)):
            chosen = groups == g
            known = float(np.sum(1.0 - alpha[g] * variances[chosen]))
            alpha[g] = np.clip(max(known, 1e-3) / max(np.sum(theta[chosen] ** 2), 1e-12), 1e-8, 1e8)
    return Fit(theta, evidence)


def _most_probable(
    network: LinearAndTanh, theta: Array, phi: Array, targets: Array, nu: float, alpha: Array
) -> Array:
    """Return θ after damped Gauss-Newton steps on the errors beside the prior."""
    damping = 1e-3
    values, J = network.jacobian(theta, phi)
    errors = (targets - values).ravel()
    cost = errors @ errors / nu + alpha @ theta**2
    for _ in range(STEPS):
        slope = J.T @ errors / nu - alpha * theta
        normal = J.T @ J / nu + np.diag(alpha)
        for _ in range(6):
            step = np.linalg.solve(normal + np.diag(damping * np.diag(normal)), slope)
            tried = theta + step
            after = (targets - network.predict(tried, phi)).ravel()
            found = after @ after / nu + alpha @ tried**2
            if found < cost:
                break
            damping *= 4.0
        else:
            return theta
        theta, damping = tried, damping / 3.0
        fall, cost = cost - found, found
        values, J = network.jacobian(theta, phi)
        errors = (targets - values).ravel()
        if fall < 1e-6 * cost:
            break
    return theta


def best_of(phi: Array, targets: Array, noise: float, restarts: int, seed: int) -> Fit:
    """Return the fit of the largest evidence from some initial parameters."""
    rng = np.random.default_rng(seed)
    return max((fit(phi, targets, noise, rng) for _ in range(restarts)), key=lambda one: one.evidence)
