"""A network on the samples of the evidence model: how much of them it reads, beside the process.

The accelerations are a(x) = A φ + W₃ tanh(W₂ tanh(W₁ φ + b₁) + b₂) + b₃. Parameters of a group have
a normal prior of one precision; noise is known. At the most probable parameters the precisions
follow from the evidence of Laplace's approximation, in turns; of some initial parameters those with
the largest evidence are kept. Reference: D. MacKay, "A practical Bayesian framework for
backpropagation networks", Neural Computation 4 (1992).

φ are the features, (p,), or products of them, θ all parameters, (q,), J the Jacobian of all
accelerations, (N r, q), and α the precisions. With H = JᵀJ/ν + diag α, a group determines
γ = Σ (1 - α (H⁻¹)_ii).
"""

from __future__ import annotations

import time
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from dopt.offline_fit import recorded_samples, sample_loss
from dopt.run import run_trial
from dopt.types import Array, Integers
from studies.conclusions import trials

SEEDS = (300, 302)
RESTARTS, ROUNDS, STEPS = 2, 25, 12
"""Initial parameters, estimates of the precisions, and Gauss-Newton steps between two of them."""


class Form(NamedTuple):
    """Network: its units, the degree of products of features, whether a feature is a group."""

    width: int
    degree: int
    by_feature: bool


FORMS = {
    "features": Form(16, 1, False),
    "features, each with a prior": Form(16, 1, True),
    "products, each with a prior": Form(8, 3, True),
}


class Cell(NamedTuple):
    """A network on the samples of trials that differ by their seed."""

    env: str
    form: str


class Row(NamedTuple):
    """Losses of the network and of the evidence model on the same samples, and its time [s]."""

    loss: float
    process: float
    seconds: float


def cells() -> list[list[Cell]]:
    """Return the cells."""
    return [[Cell(env, form) for form in FORMS] for env in trials.SYSTEMS]


def row(cell: Cell, seed: int) -> Row:
    """Run the trial, and fit the network to its samples."""
    policy = "best" if cell.env in trials.BEST else "d_optimal"
    spec = trials.Cell(cell.env, "ideal", policy, "evidence").spec(seed)
    result, system, form = run_trial(spec), spec.system, FORMS[cell.form]
    samples = recorded_samples(system, result.states, result.inputs)
    rng, start = np.random.default_rng(0), time.perf_counter()
    phi = products(system.featurize(samples.states), form.degree)
    network = Network(phi.shape[1], system.n_learned, form)
    noise = system.noise**2 / system.dt
    fits = (network.fit(phi, samples.accelerations, noise, rng) for _ in range(RESTARTS))
    theta, _ = max(fits, key=lambda one: one[1])
    seconds, grid = time.perf_counter() - start, system.grid()
    errors = network.predict(theta, products(system.featurize(grid), form.degree))
    errors -= system.learned(grid, system.horizon - 1)
    loss = float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
    return Row(loss, sample_loss(spec, result.states, result.inputs), seconds)


def products(phi: Array, degree: int) -> Array:
    """Return features (N, p) and their products up to a degree."""
    columns = [
        np.prod(phi[:, chosen], axis=1)
        for n in range(1, degree + 1)
        for chosen in combinations_with_replacement(range(phi.shape[1]), n)
    ]
    return np.stack(columns, axis=1)


class Network:
    """The network for p features and r accelerations."""

    def __init__(self, p: int, r: int, form: Form) -> None:
        w = form.width
        self.shapes = [(r, p), (w, p), (w,), (w, w), (w,), (r, w), (r,)]
        groups: list[Integers] = []
        self.outputs: list[Integers] = []  # groups in the unit of the accelerations
        for k, shape in enumerate(self.shapes):
            first = int(groups[-1].max()) + 1 if groups else 0
            own = np.arange(p) if k < 2 and form.by_feature else np.zeros(shape[-1], dtype=int)
            groups.append(first + np.broadcast_to(own, shape).ravel())
            if k in (0, 5, 6):
                self.outputs.append(groups[-1])
        self.ends, self.groups = np.cumsum([len(one) for one in groups]), np.concatenate(groups)

    def initial(self, rng: np.random.Generator) -> Array:
        """Draw parameters, (q,); A is 0."""
        parts = [rng.standard_normal(shape).ravel() / shape[-1] ** 0.5 for shape in self.shapes]
        parts[0] *= 0.0
        return np.concatenate(parts)

    def predict(self, theta: Array, phi: Array) -> Array:
        """Return accelerations, (N, r), at features, (N, p)."""
        A, W1, b1, W2, b2, W3, b3 = self._parts(theta)
        hidden = np.tanh(np.tanh(phi @ W1.T + b1) @ W2.T + b2)
        values: Array = phi @ A.T + hidden @ W3.T + b3
        return values

    def jacobian(self, theta: Array, phi: Array) -> Array:
        """Return J, (N r, q)."""
        _, W1, b1, W2, b2, W3, b3 = self._parts(theta)
        N, r = len(phi), len(b3)
        h1 = np.tanh(phi @ W1.T + b1)
        h2 = np.tanh(h1 @ W2.T + b2)
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
        return np.concatenate([one.reshape(N * r, -1) for one in blocks], axis=1)

    def _parts(self, theta: Array) -> list[Array]:
        split = np.split(theta, self.ends[:-1])
        return [part.reshape(shape) for part, shape in zip(split, self.shapes, strict=True)]

    def fit(
        self, phi: Array, targets: Array, noise: float, rng: np.random.Generator
    ) -> tuple[Array, float]:
        """Return θ for features (N, p) and accelerations (N, r), and its evidence, a logarithm.

        ``noise`` is the variance ν of an acceleration. A constant of the samples is left out.
        """
        theta, groups = self.initial(rng), self.groups
        size, alpha = float(np.mean(targets**2)) or 1.0, np.ones(groups.max() + 1)
        alpha[np.concatenate(self.outputs)] = 1.0 / size
        nu, turn = max(noise, 1e-3 * size), 0
        while True:
            nu, turn = max(noise, nu * 0.5), turn + 1  # from a rough fit to a fine one
            theta = self._most_probable(theta, phi, targets, nu, alpha[groups])
            J, errors = self.jacobian(theta, phi), (targets - self.predict(theta, phi)).ravel()
            factor = cho_factor(J.T @ J / nu + np.diag(alpha[groups]), lower=True)
            if turn == ROUNDS:
                cost = errors @ errors / nu + alpha[groups] @ theta**2 + len(errors) * np.log(nu)
                whole = 2.0 * np.log(np.diag(factor[0])).sum() - np.log(alpha[groups]).sum()
                return theta, -0.5 * float(cost + whole)
            variances = np.diag(cho_solve(factor, np.eye(len(theta))))
            gamma = np.bincount(groups, 1.0 - alpha[groups] * variances)
            squares = np.bincount(groups, theta**2)
            alpha = np.clip(np.maximum(gamma, 1e-3) / np.maximum(squares, 1e-12), 1e-8, 1e8)

    def _most_probable(
        self, theta: Array, phi: Array, targets: Array, nu: float, alpha: Array
    ) -> Array:
        """Return θ after damped Gauss-Newton steps on the errors beside the prior."""

        def cost_of(theta: Array) -> tuple[float, Array]:
            errors = (targets - self.predict(theta, phi)).ravel()
            return float(errors @ errors / nu + alpha @ theta**2), errors

        damping, (cost, errors) = 1e-3, cost_of(theta)
        for _ in range(STEPS):
            J = self.jacobian(theta, phi)
            slope, normal = J.T @ errors / nu - alpha * theta, J.T @ J / nu + np.diag(alpha)
            for _ in range(6):
                tried = theta + np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slope)
                found, missed = cost_of(tried)
                if found < cost:
                    break
                damping *= 4.0
            else:
                return theta
            fall, cost = cost - found, found
            theta, errors, damping = tried, missed, damping / 3.0
            if fall < 1e-6 * cost:
                break
        return theta
