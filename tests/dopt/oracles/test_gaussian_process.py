"""The Gaussian process: mean and entropy from the covariance matrix of all samples at once."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.models import GaussianProcess
from dopt.policies import GaussianProcessEntropy
from dopt.spec.trial import TrialSpec
from dopt.types import Array
from tests.dopt.oracles.traces import Trace, following, observed, trace
from tests.dopt.trials import trial


class Conditioned:
    """The process given all samples of a trial before a step."""

    def __init__(self, spec: TrialSpec, run: Trace, t: int) -> None:
        assert isinstance(spec.model, GaussianProcess)
        self._spec, self._model = spec, spec.model
        self._seen = spec.system.featurize(run.states[:t])
        self._noise = max(spec.system.noise**2 / spec.system.dt, 1e-10 * self._model.amplitude**2)
        K = self.kernel(self._seen, self._seen) + self._noise * np.eye(t)
        self._inverse = np.linalg.inv(K)
        self.weights = self._inverse @ np.array([observed(spec, run, s) for s in range(t)])

    def kernel(self, a: Array, b: Array) -> Array:
        squares = ((a[:, None] - b[None]) ** 2).sum(axis=2)
        found: Array = self._model.amplitude**2 * np.exp(-squares / 2 / self._model.lengthscale**2)
        return found

    def mean(self, x: Array) -> Array:
        """Return the posterior mean, (r,), at a state."""
        found: Array = self.kernel(self._spec.system.featurize(x[None]), self._seen) @ self.weights
        return found[0]

    def entropy(self, path: Array) -> float:
        """Return log det of the covariance of what would be observed on a path, (H, d)."""
        phi = self._spec.system.featurize(path)
        cross = self.kernel(phi, self._seen)
        S = self.kernel(phi, phi) - cross @ self._inverse @ cross.T
        return float(np.linalg.slogdet(S + self._noise * np.eye(len(path)))[1])


@pytest.mark.parametrize(("env", "lookahead"), [("pendulum", 1), ("arm", 3)])
def test_the_entropy_of_no_candidate_is_larger(env: str, lookahead: int) -> None:
    policy = {"lookahead": lookahead, "candidates": 5}
    spec = trial(env, "gaussian_process", 3, env={"horizon": 14}, policy=policy)
    run = trace(spec)
    assert isinstance(spec.policy, GaussianProcessEntropy)
    candidates = spec.policy.compared_inputs(spec.system)
    for t in (1, 5, 13):
        process, values = Conditioned(spec, run, t), []
        alpha = spec.system.horizon * len(spec.system.features)
        weights = run.parameters[t][alpha:].reshape(-1, spec.system.horizon).T
        size = np.abs(process.weights).max()
        assert weights[:t] == pytest.approx(process.weights, abs=1e-7 * size)
        for u in candidates:
            path = [run.states[t]]
            for _ in range(lookahead):
                path.append(following(spec, path[-1], u, process.mean(path[-1])))
            values.append(process.entropy(np.array(path[1:])))
        chosen = np.flatnonzero((candidates == run.inputs[t]).all(axis=1))
        assert values[chosen[0]] >= max(values) - 1e-6 * np.ptp(values)
