"""Fits of the kernels of a trial's Gaussian processes between compiled steps."""

from __future__ import annotations

import time
from typing import TypeGuard

import numpy as np

from dopt.evidence import Request, evenly, fit_rows, guessed
from dopt.kernel.gaussian_process import refactor, thin
from dopt.kernel.pointers import compiled_for, kind_of, path_of
from dopt.kernel.structs import Evaluation, Trial
from dopt.learning import Conditioning
from dopt.models.base import Model
from dopt.models.gaussian_process import GaussianProcess
from dopt.randomness import stream
from dopt.spec.trial import TrialSpec
from dopt.types import Array, CompiledFunction

FITS_WITH_RESTARTS = 4
"""First fits, of few samples, that also start from guesses."""


def is_tuned(model: Model) -> TypeGuard[GaussianProcess]:
    """Return True if the evidence chooses the kernels of a model."""
    return isinstance(model, GaussianProcess) and model.is_tuned


MOST_FITTED = 1000
"""Most samples of a fit; of more it takes an even choice."""


class Evidence:
    """The fits of one trial.

    Attributes
    ----------
    due : int
        Number of steps after which the next fit is due.
    numbers : (r, 2p + 3)
        Numbers of the kernels, a view of the parameters.
    """

    def __init__(self, spec: TrialSpec, trial: Trial) -> None:
        assert isinstance(spec.learner, Conditioning)
        assert isinstance(spec.model, GaussianProcess)
        self._trial, self._learner = trial, spec.learner
        self._noise = spec.model.known_noise(spec.system)
        r, size = spec.system.n_learned, 2 * len(spec.system.features) + 3
        self.numbers = trial.state.theta[-r * size :].reshape(r, size)
        self._normals = stream(spec.seed, "evidence").standard_normal((FITS_WITH_RESTARTS, r, size))
        self._done, self.due = 0, spec.learner.next_fit(0)

    def request(self) -> Request:
        """Return what the next fit needs: a copy, and the samples go on."""
        network, state = self._trial.network, self._trial.state
        n = int(network.process.n_samples[0])
        p = network.sizes[0]
        chosen = evenly(n, MOST_FITTED)
        phi = state.theta[: p * network.process.room].reshape(p, -1)[:, chosen]
        targets, starts = state.posterior.targets[:, chosen], self.numbers[:, None].copy()
        if self._done < FITS_WITH_RESTARTS:
            guesses = np.array([guessed(phi, y) for y in targets])[:, None]
            drawn = guesses * np.exp(self._normals[self._done][:, None])
            starts = np.concatenate([*([starts] if self._done else []), guesses, drawn], axis=1)
        return Request(phi, targets, state.posterior.counts[chosen], starts, self._noise)

    def take(self, numbers: Array, samples: int) -> None:
        """Let the numbers of a fit after so many steps come into force."""
        self._call(thin)
        self.numbers[:] = numbers
        self._call(refactor)
        self._done += 1
        self.due = self._learner.next_fit(samples)

    def _call(self, function: CompiledFunction) -> None:
        network, state = self._trial.network, self._trial.state
        given = network, state.theta, state.posterior
        compiled_for(path_of(function), function, tuple(map(kind_of, given)))(*given)

    def fit(self, points: Evaluation) -> float:
        """Fit the kernels, with as many samples as were due; return the time that it took [µs]."""
        begun = time.perf_counter()
        self.take(fit_rows(self.request()), self.due)
        points.n_basis[0] = 0
        return 1e6 * (time.perf_counter() - begun)
