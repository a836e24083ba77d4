"""View of a running trial that custom policies and learners receive, as numpy arrays."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import numpy.typing as npt

from dopt.arguments import whole
from dopt.systems.base import System

Array = npt.NDArray[np.float64]


class TrialView(ABC):
    """A trial after t steps: what was observed, and the model as it is now.

    Attributes
    ----------
    system : System
        Sizes, known part, γ and dt are what an explorer may use of it; its accelerations are not.
    t : int
        Number of steps done.
    states : (t + 1, d)
        x_0 ... x_t, or their estimates.
    inputs : (t, m)
        u_0 ... u_{t-1}.
    sampled_inputs : (t, m)
        Inputs that belong to ``accelerations``: the same, or filtered as estimates are.
    sampled : (t, d)
        States at which the accelerations were observed: x_0 ... x_{t-1}, and with
        ``env.integrator=rk4`` the middle of each step.
    accelerations : (t, r)
        Observed there: (x_{s+1} - x_s)/dt less the known part, in the learned rows; with rk4 also
        less the difference between the model's integrated step and its pointwise acceleration.
    parameters : (q,)
        Parameters θ of the model that are learned.
    tie : (m,)
        Random direction of step t, of norm 1: the numbers that a compiled policy has in
        ``randomness.ties[t]``. NaN after the last step.
    """

    system: System
    t: int
    states: Array
    inputs: Array
    sampled_inputs: Array
    sampled: Array
    accelerations: Array
    parameters: Array
    tie: Array

    @abstractmethod
    def points(self, states: Array, inputs: Array) -> Array:
        """Return what the model depends on at states, (N, d), under inputs, (N, m).

        They are the states, or with a model that reads inputs the states with the inputs behind
        them, (N, d + m): :meth:`predict` and the Jacobians then take these in place of states.
        """

    @abstractmethod
    def predict(self, states: Array) -> Array:
        """Return the modelled accelerations a_θ(x), (N, r), of states, (N, d)."""

    @abstractmethod
    def jacobian(self, state: Array) -> Array:
        """Return ∂a_θ(x)/∂θ, (r, q), at a state, (d,)."""

    @abstractmethod
    def jacobian_change(self, state: Array, directions: Array) -> Array:
        """Return the derivative of the Jacobian along k directions (k, d) of the state: (k, r, q).

        With the columns of :meth:`input_matrix` it is what Proposition 1 calls D B.
        """

    @property
    def covariance(self) -> Array:
        """Inverse of the information matrix, (q, q), where policy or learner holds one.

        A sample with the rows J adds JᵀJ to the inverse of it. It is M⁻¹, or M⁻¹/ρ with a learner
        whose samples add JᵀJ/ρ to M.
        """
        raise NotImplementedError

    @abstractmethod
    def following(self, state: Array, inputs: Array) -> Array:
        """Return the predicted next states, (N, d), for inputs (N, m) at (d,)."""

    def held(self, inputs: Array, steps: int) -> Array:
        """Return the predicted states, (N, d), after steps in which each input, (N, m), is held."""
        steps = whole("the number of steps for which an input is held", steps, 1)
        states = self.following(self.states[-1], inputs)
        for _ in range(steps - 1):
            following = (self.following(x, u[None]) for x, u in zip(states, inputs, strict=True))
            states = np.concatenate(list(following))
        return states

    @abstractmethod
    def input_matrix(self, state: Array) -> Array:
        """Return B = dt ∂f/∂u, (d, m), at a state, (d,)."""
