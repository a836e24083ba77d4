"""States, inputs, errors and predictions of an exploration so far."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError
from dopt.explorer.arguments import reals
from dopt.explorer.recorded_run import free_run_error
from dopt.explorer.state import ExplorerState
from dopt.spec.trial import TrialSpec
from dopt.types import Array

KINDS = (
    "learned",
    "repeated",
    "out_of_order",
    "gaps",
    "unusable",
    "jumps",
    "resets",
    "missed",
)
"""Kinds of events in :attr:`Explored.counts`."""


class Explored:
    """States, inputs, errors and predictions of an exploration.

    Attributes
    ----------
    spec : TrialSpec
        Plant, policy, model, learner and seed.
    """

    def __init__(self, spec: TrialSpec) -> None:
        self.spec, self._state = spec, ExplorerState(spec)

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of events of each kind since the first step of the journal."""
        return {kind: self._state.counts[kind] for kind in KINDS}

    @property
    def n_steps(self) -> int:
        """Steps t that were learned from."""
        return self._state.done

    @property
    def parameters(self) -> Array:
        """Parameters of the model, (q,)."""
        return self._state.steps.parameters

    @property
    def states(self) -> Array:
        """States x_0 ... x_t from which steps were taken, and the last one, (t + 1, d).

        Where states are measured with noise they are estimates.

        Where the exploration went on from another state, as after a gap, that one is here.
        """
        return self._state.steps.states[: self.n_steps + 1].copy()

    @property
    def inputs(self) -> Array:
        """Inputs that were applied, (t, m)."""
        return self._state.steps.inputs[: self.n_steps].copy()

    @property
    def errors(self) -> Array:
        """Errors ‖y - a_θ(x, u)‖ of the accelerations, each before it was learned, (t,).

        Where states are measured with noise, they are those of the predicted measurements, in
        standard deviations of their noise.
        """
        return self._state.steps.errors[: self.n_steps].copy()

    def predict(self, states: npt.ArrayLike, inputs: npt.ArrayLike | None = None) -> Array:
        """Return the learned accelerations, (N, r), at states, (N, d), and inputs, (N, m).

        Inputs count in a model that reads them, such as 'affine'; without any they are 0.
        """
        return predict(self.spec, self.parameters, states, inputs)

    def free_run_error(
        self, states: npt.ArrayLike, inputs: npt.ArrayLike, steps: int = 50
    ) -> float:
        """Return the error of predictions of a recorded run from its start, without measurements.

        Parameters
        ----------
        states, inputs : (T + 1, d), (T, m)
            States that were measured dt apart, and the inputs between them; best of another run
            than the one that was learned from. Of a plant some of whose states are measured it may
            be these alone, (T + 1, n).
        steps : int
            Steps of a prediction; the run is cut into as many of them as it holds. Where states are
            measured the first piece has no prediction: the states are estimated in it.

        Returns
        -------
        float
            Relative root mean square error, without a unit: 0 for perfect predictions, 1 for those
            that nothing changes (:func:`dopt.control.free_run.relative_error`). That of measured
            states alone has their noise in it.

        Raises
        ------
        SpecificationError
            If the shapes do not fit, or the run has fewer steps.
        """
        return free_run_error(self.spec, self.predict, states, inputs, steps)


def predict(
    spec: TrialSpec,
    parameters: Array,
    states: npt.ArrayLike,
    inputs: npt.ArrayLike | None = None,
) -> Array:
    """Return the accelerations, (N, r), that a model of given parameters has learned."""
    system = spec.system
    at = _rows("states", states, system.n_states)
    u = None if inputs is None else _rows("inputs", inputs, system.n_inputs)
    if u is not None and len(u) != len(at):
        raise SpecificationError(
            f"{len(at)} states and {len(u)} inputs were given, but as many of both are expected: "
            f"give the input of each state."
        )
    predicted: Array = spec.model.predict(system, parameters, at, u)
    return predicted


def _rows(what: str, given: npt.ArrayLike, size: int) -> Array:
    rows = np.atleast_2d(reals(what, given))
    if rows.ndim != 2 or rows.shape[1] != size:
        raise SpecificationError(
            f"{what} of shape {np.shape(given)} were given, but (N, {size}) is expected: correct "
            f"them."
        )
    return rows
