"""Fits of the kernels of Gaussian processes by their evidence.

The logarithms η of the numbers of a kernel (:mod:`dopt.kernel.gaussian_process`) minimise
-log p(y | η) beside a weak prior, each normal about a guess that the sizes of the accelerations
give: a few samples cannot decide about all numbers. The derivatives are exact, the minimiser is
L-BFGS-B of SciPy. Reference: C. Rasmussen and C. Williams, "Gaussian processes for machine
learning" (2006), section 5.4.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from dopt.kernel.gaussian_process import add_sample, negative_evidence, refactor, thin
from dopt.kernel.pointers import compiled_for, kind_of
from dopt.kernel.structs import Evaluation, Network, Posterior, Trial
from dopt.learning import Conditioning
from dopt.models.base import Model
from dopt.models.gaussian_process import ROUNDING, GaussianProcess, kernel
from dopt.randomness import stream
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.types import Array, CompiledFunction, Integers

SPREADS = (2.0, 4.0, 4.0, 4.0, 4.0)
"""Standard deviations of the logarithms of w, s², l, c and ν."""

GUESSES = (1.0, 1.0, 0.1, 0.1, 1e-4)
"""Guesses of w, s², l, c and ν, but w in units of the mean square of the accelerations."""

FARTHEST = 6.0
"""Bounds of the logarithms, in their standard deviations."""


MOST_STEPS = 30
"""Iterations of a fit in a trial."""

FEW = 150
"""Samples of the first part of a fit."""

MANY = 500
"""Samples of its second part: its time grows with their cube."""

MOST = 20
"""Iterations of its second part."""

FITS_WITH_RESTARTS = 4
"""First fits, of few samples, that also start from guesses."""

MOST_FITTED = 1000
"""Most samples of a fit; of more, an even choice is taken."""


def guessed(phi: Array, y: Array) -> Array:
    """Return the guess of the numbers, (2p + 3,), for features (p, n) and accelerations (n,)."""
    size = float(np.mean(y**2)) or 1.0
    w, s, slope, constant, noise = GUESSES
    p = len(phi)
    return np.array([w] * p + [s * size] + [slope * size] * p + [constant * size, noise * size])


def fit_numbers(
    phi: Array,
    y: Array,
    counts: Array,
    starts: Sequence[Array],
    noise: float | None,
    most_steps: int,
) -> Array:
    """Return the numbers of a kernel, (2p + 3,), with the largest evidence that a fit has found.

    Parameters
    ----------
    phi : (p, n)
        Features of the samples.
    y : (n,)
        Accelerations of one row.
    counts : (n,)
        Observations of which each sample is the mean.
    starts : sequence of (2p + 3,)
        Numbers from which a fit starts.
    noise : float or None
        Variance ν of an observation, if it is known.
    most_steps : int
        Most iterations of a fit.
    """
    from scipy.optimize import minimize  # whose import takes long

    p, guess = len(phi), np.log(guessed(phi, y))
    spread = np.repeat(SPREADS, (p, 1, p, 1, 1))
    free = np.arange(2 * p + (3 if noise is None else 2))
    kinds = tuple(map(kind_of, (y, np.zeros((1, 1)), y, y, y)))
    code: Any = compiled_for(negative_evidence, kinds)
    phi, y = np.ascontiguousarray(phi), np.ascontiguousarray(y)

    def cost(eta: Array) -> tuple[float, Array]:
        numbers, slope = completed(eta), np.empty(2 * p + 3)
        value = code(numbers, phi, y, counts, slope)
        if not np.isfinite(value):
            return 1e10, np.zeros(len(free))
        apart = (eta - guess[free]) / spread[free]
        return value + 0.5 * float(apart @ apart), slope[free] + apart / spread[free]

    def completed(eta: Array) -> Array:
        numbers: Array = np.exp(np.concatenate([eta, guess[len(free) :]]))
        least = ROUNDING * (numbers[p] + numbers[p + 1 : 2 * p + 2].sum())
        numbers[-1] = max(numbers[-1] if noise is None else noise, least)
        return numbers

    reach = FARTHEST * spread[free]
    lower, upper = guess[free] - reach, guess[free] + reach
    found = [
        minimize(
            cost,
            np.clip(np.log(np.maximum(start[free], 1e-300)), lower, upper),
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip(lower, upper, strict=True)),
            options={"maxiter": most_steps, "maxfun": 2 * most_steps},
        )
        for start in starts
    ]
    numbers: Array = completed(min(found, key=lambda one: one.fun).x)
    return numbers


class Request(NamedTuple):
    """Samples of all rows, and where the fits start.

    Attributes
    ----------
    phi : (p, n)
    targets : (r, n)
    counts : (n,)
    starts : (r, k, 2p + 3)
    noise : float or None
        As of :func:`fit_numbers`.
    """

    phi: Array
    targets: Array
    counts: Array
    starts: Array
    noise: float | None


def fit_rows(request: Request) -> Array:
    """Return the numbers of the kernel of each row, (r, 2p + 3)."""
    phi, targets, counts, starts, noise = request
    rows = zip(targets, starts, strict=True)
    return np.array([fit_numbers(phi, y, counts, at, noise, MOST_STEPS) for y, at in rows])


def fit_process(
    model: GaussianProcess, system: System, states: Array, accelerations: Array, seed: int
) -> Array:
    """Return the parameters of a process, (q,), fitted to samples: its kernels and its mean.

    A fit of the evidence starts from a guess and from random numbers, on an even choice of the
    samples, and goes on with more of them. Of more samples than there is room for the process takes
    an even choice.

    Parameters
    ----------
    model : GaussianProcess
    system : System
    states : (N, d)
    accelerations : (N, r)
    seed : int
        Seed of the trial, from which the random numbers come.
    """
    from scipy.linalg import cho_factor, cho_solve

    rng, C = stream(seed, "evidence"), model.room(system)
    chosen = evenly(len(states), C)
    phi, targets = system.featurize(states[chosen]).T.copy(), accelerations[chosen].T.copy()
    (p, n), r = phi.shape, system.n_learned
    parameters = model.initial_parameters(system, rng)
    parameters[: p * C].reshape(p, C)[:, :n] = phi
    known = model.known_noise(system)
    few, many = evenly(n, FEW), evenly(n, MANY)
    for k, y in enumerate(targets):
        numbers = model.fixed_numbers(system)
        if model.is_tuned:
            guess = guessed(phi, y)
            starts = [guess, guess * np.exp(rng.standard_normal(len(guess)))]
            numbers = fit_numbers(phi[:, few], y[few], np.ones(len(few)), starts, known, 2 * MOST)
            if len(few) < n:
                ones = np.ones(len(many))
                numbers = fit_numbers(phi[:, many], y[many], ones, [numbers], known, MOST)
            parameters[(p + r) * C :].reshape(r, -1)[k] = numbers
        K = kernel(numbers, phi.T, phi.T) + numbers[-1] * np.eye(n)
        parameters[(p + k) * C : (p + k) * C + n] = cho_solve(cho_factor(K), y)
    return parameters


def evenly(count: int, most: int) -> Integers:
    """Return at most ``most`` of ``count`` indices, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def is_tuned(model: Model) -> TypeGuard[GaussianProcess]:
    """Return True if the evidence chooses the kernels of a model."""
    return isinstance(model, GaussianProcess) and model.is_tuned


class Samples(NamedTuple):
    """Samples of a process, with its parameters and its factors."""

    network: Network
    theta: Array
    posterior: Posterior

    def call(self, function: CompiledFunction, *more: Array) -> Any:
        """Call a compiled function with these arrays first."""
        kinds = tuple(map(kind_of, (*self, *more)))
        return compiled_for(function, kinds)(*self, *more)

    def copied(self) -> Samples:
        """Return a copy that shares the factors, in the half that is not in force."""
        network, theta, posterior = self
        n_samples = network.process.n_samples.copy()
        parts = posterior._asdict().items()
        copies = {name: part.copy() for name, part in parts if name != "factors"}
        other = posterior._replace(**copies)
        other.first[0] = len(posterior.factors) // 2 - posterior.first[0]
        process = network.process._replace(n_samples=n_samples)
        return Samples(network._replace(process=process), theta.copy(), other)

    def replace(self, other: Samples) -> None:
        """Copy all arrays of another except its factors."""
        own, others = (
            (one.network.process.n_samples, one.theta, *one.posterior[1:]) for one in (self, other)
        )
        for array, values in zip(own, others, strict=True):
            array[:] = values

    def renumber(self, numbers: Array) -> None:
        """Thin the samples, and write the factors and the mean for other numbers, (r, 2p + 3).

        The present ones stay where rounding leaves K + νI indefinite with the new ones.
        """
        self.call(thin)
        present = self.theta[-numbers.size :].reshape(numbers.shape)
        before = present.copy()
        present[:] = numbers
        if not self.call(refactor):
            present[:] = before
            self.call(refactor)


def renewed(samples: Samples, numbers: Array) -> Samples:
    """Return samples with factors, (G, n, n), for other numbers, (r, 2p + 3).

    These begin at 0.
    """
    n, first = samples.network.process.n_samples, np.zeros(1, dtype=np.int64)
    factors = np.zeros((len(numbers), n[0], n[0]))
    posterior = samples.posterior._replace(factors=factors, first=first)
    samples = samples._replace(posterior=posterior)
    samples.renumber(numbers)
    kept = np.ascontiguousarray(factors[:, : n[0], : n[0]])
    return samples._replace(posterior=posterior._replace(factors=kept))


class Renewal:
    """A posterior with other numbers that is made beside the one in force.

    It has the samples as they were when it began, thinned, and those since.

    Parameters
    ----------
    present : Samples
        Those in force, in whose unused factors it writes.
    numbers : (r, 2p + 3)
    """

    def __init__(self, present: Samples, numbers: Array) -> None:
        self._present, self._samples, self._numbers = present, present.copied(), numbers
        self._since: list[tuple[Array, Array]] = []  # states, (d,), and accelerations, (r,)
        self._added, self._is_made = 0, False

    def note(self) -> None:
        """Remember the newest sample of the posterior in force."""
        newest = self._present.posterior.newest_state, self._present.posterior.newest_target
        self._since.append((newest[0].copy(), newest[1].copy()))

    def request(self) -> tuple[Samples, Array]:
        """Return what :func:`renewed` is given."""
        posterior = self._samples.posterior._replace(factors=np.zeros((0, 0, 0)))
        return self._samples._replace(posterior=posterior), self._numbers

    def install(self, made: Samples) -> None:
        """Copy what another process has made, and add the samples since. Any thread may call it."""
        own, factors = self._samples.posterior, made.posterior.factors
        first, (G, n, _) = own.first.copy(), factors.shape
        np.copyto(own.factors[first[0] : first[0] + G, :n, :n], factors)
        self._samples.replace(made)
        own.first[:] = first
        self._is_made = True
        self._add_those_since()

    def finish(self) -> None:
        """Add the samples that are left, and bring the posterior into force."""
        if not self._is_made:
            self._samples.renumber(self._numbers)
        self._add_those_since()
        self._present.replace(self._samples)

    def _add_those_since(self) -> None:
        while self._added < len(self._since):
            self._samples.call(add_sample, *self._since[self._added])
            self._added += 1


class Evidence:
    """The fits of one trial.

    Attributes
    ----------
    due : int
        Number of steps after which the next fit is due.
    numbers : (r, 2p + 3)
        Numbers of the kernels, a view of the parameters.
    renewal : Renewal or None
        Samples with the numbers of the last fit, until they come into force.
    """

    def __init__(self, spec: TrialSpec, trial: Trial) -> None:
        assert isinstance(spec.learner, Conditioning)
        assert isinstance(spec.model, GaussianProcess)
        self._samples = Samples(trial.network, trial.state.theta, trial.state.posterior)
        self._learner = spec.learner
        self.renewal: Renewal | None = None
        self._noise = spec.model.known_noise(spec.system)
        r, size = spec.system.n_learned, 2 * len(spec.system.features) + 3
        self.numbers = trial.state.theta[-r * size :].reshape(r, size)
        self._normals = stream(spec.seed, "evidence").standard_normal((FITS_WITH_RESTARTS, r, size))
        self._done, self.due = 0, spec.learner.next_fit(0)

    def request(self) -> Request:
        """Return a copy of what the next fit needs."""
        network, theta, posterior = self._samples
        n = int(network.process.n_samples[0])
        p = network.sizes[0]
        chosen = evenly(n, MOST_FITTED)
        phi = theta[: p * network.process.room].reshape(p, -1)[:, chosen]
        targets, starts = posterior.targets[:, chosen], self.numbers[:, None].copy()
        if self._done < FITS_WITH_RESTARTS:
            guesses = np.array([guessed(phi, y) for y in targets])[:, None]
            drawn = guesses * np.exp(self._normals[self._done][:, None])
            starts = np.concatenate([*([starts] if self._done else []), guesses, drawn], axis=1)
        return Request(phi, targets, posterior.counts[chosen], starts, self._noise)

    def take(self, numbers: Array, steps: int) -> None:
        """Bring the numbers of a fit into force after ``steps`` steps."""
        self._samples.renumber(numbers)
        self._done += 1
        self.due = self._learner.next_fit(steps)

    def begin_renewal(self, numbers: Array) -> None:
        """Begin a posterior with the numbers of a fit; the present one stays in force."""
        self.renewal = Renewal(self._samples, numbers)
        self._done += 1

    def first_request(self) -> tuple[Samples, Array]:
        """Return a small request; load the code of renewals, touch the memory of the factors."""
        factors = self._samples.posterior.factors
        factors += 0.0  # a step that touches new pages of 2 MiB takes 5 ms longer
        small = Renewal(self._samples, self.numbers)
        request = small.request()
        small.note()
        small.install(renewed(*request))
        return request

    def fit(self, points: Evaluation) -> float:
        """Fit the kernels when due, and return the time taken [µs]."""
        begun = time.perf_counter()
        self.take(fit_rows(self.request()), self.due)
        points.n_basis[0] = 0
        return 1e6 * (time.perf_counter() - begun)
