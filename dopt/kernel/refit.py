"""Fits of the kernels of a trial's Gaussian processes between compiled steps."""

from __future__ import annotations

import time
from typing import Any, TypeGuard

import numpy as np

from dopt.evidence import fit_numbers, guessed
from dopt.kernel.gaussian_process import refactor
from dopt.kernel.pointers import compiled_for, kind_of
from dopt.kernel.structs import Evaluation, Trial
from dopt.learning import Conditioning
from dopt.models.base import Model
from dopt.models.gaussian_process import GaussianProcess
from dopt.randomness import stream
from dopt.spec.trial import TrialSpec
from dopt.types import Array

MOST_STEPS = 30
"""Iterations of a fit."""

FITS_WITH_RESTARTS = 4
"""First fits, of few samples, that also start from guesses."""


def is_tuned(model: Model) -> TypeGuard[GaussianProcess]:
    """Return True if the evidence chooses the kernels of a model."""
    return isinstance(model, GaussianProcess) and model.is_tuned


class Evidence:
    """The fits of one trial.

    Attributes
    ----------
    due : int
        Number of samples with which the next fit is due.
    """

    def __init__(self, spec: TrialSpec, trial: Trial) -> None:
        assert isinstance(spec.learner, Conditioning)
        assert isinstance(spec.model, GaussianProcess)
        self._spec, self._trial, self._learner, self._model = spec, trial, spec.learner, spec.model
        self._rng, self._done = stream(spec.seed, "evidence"), 0
        self.due = spec.learner.next_fit(0)

    @property
    def numbers(self) -> Array:
        """Numbers of the kernels, (r, 2p + 3), a view of the parameters."""
        r = self._spec.system.n_learned
        size = r * (2 * len(self._spec.system.features) + 3)
        view: Array = self._trial.state.theta[-size:].reshape(r, -1)
        return view

    def fit(self, points: Evaluation | None = None) -> float:
        """Fit the kernels to all samples, and return the time that it took [µs]."""
        begun = time.perf_counter()
        network, state = self._trial.network, self._trial.state
        n, p = int(network.process.n_samples[0]), network.sizes[0]
        phi = state.theta[: p * network.process.room].reshape(p, -1)[:, :n]
        counts, known = state.posterior.counts[:n], None
        if self._model.noise == "known":
            known = self._model.noise_variance(self._spec.system)
        for row, y in zip(self.numbers, state.posterior.targets[:, :n], strict=True):
            starts = [row.copy()]
            if self._done < FITS_WITH_RESTARTS:
                guess = guessed(phi, y)
                starts += [guess, guess * np.exp(self._rng.standard_normal(len(guess)))]
            if self._done == 0:
                starts = starts[1:]
            row[:] = fit_numbers(phi, y, counts, starts, known, MOST_STEPS)
        code: Any = compiled_for(
            "refactor", refactor, tuple(map(kind_of, (network, state.theta, state.posterior)))
        )
        code(network, state.theta, state.posterior)
        if points is not None:
            points.n_basis[0] = 0
        self._done += 1
        self.due = self._learner.next_fit(n)
        return 1e6 * (time.perf_counter() - begun)
