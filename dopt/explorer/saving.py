"""Saves of an exploration to a results database: the one part of dopt that uses orchestrate."""

from __future__ import annotations

import functools
import threading
import time
import weakref
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dopt.assessment import violations
from dopt.errors import ExplorationError, SpecificationError
from dopt.explorer.explored import Explored, predict
from dopt.explorer.recorded_run import free_run_error
from dopt.result import Assessment, TrialResult
from dopt.spec.prequential import PrequentialTrial
from dopt.spec.trial import TrialSpec
from dopt.types import Array

if TYPE_CHECKING:
    from orchestrate.runner.saving import ExplorationSaver

Run = tuple[npt.ArrayLike, npt.ArrayLike]
"""States, (T + 1, d), and inputs, (T, m)."""


class SavedExplored(Explored):
    """An exploration that can be saved while it goes on.

    Whatever changes it holds ``_lock``, so that another thread can save it.
    """

    def __init__(self, spec: TrialSpec) -> None:
        super().__init__(spec)
        self._lock = threading.Lock()
        self._closed = False
        self._saving = threading.Lock()
        self._savers: dict[str | None, ExplorationSaver] = {}
        weakref.finalize(self, _close, self._savers)
        self._begun = time.perf_counter(), time.process_time()

    def save(self, url: str | None = None, test: Run | None = None) -> bool:
        """Store the exploration so far as a trial in the results database of the launches.

        The loss of its steps is :attr:`errors`: prequential, and not that of a grid. Called again,
        also after the journal was reopened, it adds the new steps to the same trial in one
        transaction. It may be called from another thread than :meth:`ask` and :meth:`tell`.

        Parameters
        ----------
        url : str, optional
            Database, such as ``sqlite:///results.db``; by default that of a launch.
        test : (states, inputs), optional
            Another recorded run, of shapes (T + 1, d) and (T, m). The error of predictions of it
            (:meth:`free_run_error`) is stored as the assessment ``free_run_error``.

        Returns
        -------
        bool
            Whether something was written: not before the first step is learned, nor where more
            steps of this exploration are stored already.

        Raises
        ------
        StoreError
            If nothing was written, because the database fails, or because it holds another
            exploration of the same arguments. What was stored stays, and the exploration can go on.
        ExplorationError
            If the package orchestrate is not installed.
        SpecificationError
            If the test run has other shapes.
        """
        with self._saving:
            if url not in self._savers:
                self._savers[url] = _new_saver(url)
            try:
                result = self._result(test)
                trial = PrequentialTrial(self.spec)
                return bool(len(result.loss)) and self._savers[url].save(trial, result)
            finally:
                if self._closed:
                    _close(self._savers)

    def _result(self, test: Run | None) -> TrialResult:
        with self._lock:
            states, inputs, errors = self.states, self.inputs, self.errors
            parameters, excess = self.parameters.copy(), self._state.excess[: self.n_steps].copy()
        at = _diverged_at(errors, parameters)
        n = len(errors) if at is None else at
        errors[n:] = np.nan
        unknown = np.full(len(errors), np.nan)
        tested: tuple[Assessment, ...] = ()
        if test is not None:
            tested += (self._tested(test, n, parameters),)
        if self.spec.limits is not None:
            tested += violations(excess[:n])
        return TrialResult(
            loss=errors,
            reachable_loss=unknown,
            plan_us=unknown,
            learn_us=unknown,
            evaluate_us=unknown,
            states=states,
            inputs=inputs,
            parameters=parameters,
            diverged_at=at,
            wall_seconds=time.perf_counter() - self._begun[0],
            cpu_seconds=time.process_time() - self._begun[1],
            assessments=tested,
        )

    def _tested(self, test: object, n: int, parameters: Array) -> Assessment:
        if not isinstance(test, tuple | list) or len(test) != 2:
            raise SpecificationError(
                f"test is {type(test).__name__}, but a pair (states, inputs) is expected: give "
                f"those of a recorded run."
            )
        predicted = functools.partial(predict, self.spec, parameters)
        return Assessment(n, "free_run_error", free_run_error(self.spec, predicted, *test))

    def _close_savers(self) -> None:
        """End the launches of the saves."""
        with self._saving:
            _close(self._savers)


def _close(savers: dict[str | None, ExplorationSaver]) -> None:
    while savers:
        savers.popitem()[1].close()


def _new_saver(url: str | None) -> ExplorationSaver:
    try:
        from orchestrate.runner.saving import ExplorationSaver
    except ModuleNotFoundError as error:
        raise ExplorationError(
            f"an exploration is saved by the package orchestrate, but {error.name} is not "
            f"installed: install dopt with its dependencies."
        ) from error
    return ExplorationSaver(url)


def _diverged_at(errors: Array, parameters: Array) -> int | None:
    """Return the first step whose error, or the parameters after it, are not finite."""
    if not np.isfinite(errors).all():
        return int(np.argmin(np.isfinite(errors)))
    return None if np.isfinite(parameters).all() or not len(errors) else len(errors) - 1
