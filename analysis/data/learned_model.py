"""Model that a stored trial learned, as a function of the state."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.errors import AnalysisError
from dopt.spec.prequential import is_prequential, stored_trial
from dopt.spec.trial import TrialSpec
from orchestrate.store import ConfigRow, Reader

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LearnedModel:
    """The model of a trial with the parameters that it had learned at the end.

    Attributes
    ----------
    spec : TrialSpec
        The trial; ``spec.system`` has the true accelerations, ``spec.system.learned(states)``.
    parameters : (q,)
        Parameters of the model, as stored.
    """

    spec: TrialSpec
    parameters: Array

    def predict(self, states: npt.ArrayLike, inputs: npt.ArrayLike | None = None) -> Array:
        """Return the learned accelerations, or with inputs the whole derivative of the state.

        Parameters
        ----------
        states : (N, d) or (d,)
            States in the units of ``spec.system.state_labels``.
        inputs : (N, m) or (m,), optional
            Inputs in the units of ``spec.system.input_labels``.

        Returns
        -------
        (N, r) or (r,)
            Accelerations at zero input, one for each learned row of the state, per second what that
            state is measured in. With inputs dx/dt = known(x, u) + E a(x), (N, d) or (d,).

        Raises
        ------
        AnalysisError
            If they are no numbers, or not of the shapes above.
        """
        x = _rows(states, self.spec.system.n_states, "states")
        single = np.ndim(states) == 1
        u = None if inputs is None else _rows(inputs, self.spec.system.n_inputs, "inputs")
        if u is not None and len(u) not in (1, len(x)):
            raise AnalysisError(
                f"inputs have {len(u)} rows and states have {len(x)}, but as many are expected: "
                f"give one input for each state."
            )
        values = self.spec.model.predict(self.spec.system, self.parameters, x, u)
        if u is not None:
            values = self._derivative(x, u, values)
        return values[0] if single else values

    def _derivative(self, x: Array, u: Array, accelerations: Array) -> Array:
        system = self.spec.system
        known = system.known(tuple(x.T), tuple(u.T), system.parameters)
        flow = np.stack([np.broadcast_to(row, len(x)) for row in known], axis=-1).astype(float)
        flow[:, list(system.learned_rows)] += accelerations
        return flow


def _rows(given: npt.ArrayLike, size: int, what: str) -> Array:
    try:
        rows = np.atleast_2d(np.asarray(given, dtype=float))
    except (TypeError, ValueError) as error:
        raise AnalysisError(
            f"{what} are {reprlib.repr(given)}, but numbers of the shape (N, {size}) or ({size},) "
            f"are expected: give one row for each point."
        ) from error
    if rows.ndim != 2 or rows.shape[1] != size:
        raise AnalysisError(
            f"{what} have the shape {np.shape(given)}, but (N, {size}) or ({size},) is expected: "
            f"give one row for each point."
        )
    return rows


def learned_model(reader: Reader, configuration: ConfigRow, seed: int) -> LearnedModel:
    """Read the final parameters of a trial; raise ``QueryError`` where it is not finished."""
    spec = stored_trial(configuration.config, seed)
    parameters = reader.trajectory(configuration.config_key, seed).parameters
    return LearnedModel(spec, parameters)


def simulated_trial(configuration: ConfigRow, seed: int) -> TrialSpec:
    """Return the specification of a trial, to run it or its system again.

    Raises
    ------
    AnalysisError
        If it is an exploration, which nothing can simulate.
    """
    if is_prequential(configuration.config):
        raise AnalysisError(
            f"{configuration.env} × {configuration.policy} is an exploration that was measured, "
            f"but a trial that can be simulated again is needed here: choose another one."
        )
    return stored_trial(configuration.config, seed)
