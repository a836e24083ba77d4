"""Validation of a result before it is written."""

from __future__ import annotations

import numpy as np

from orchestrate.store.errors import InvalidResultError
from orchestrate.store.records import Result
from orchestrate.store.schema import STEP_VALUES


def check_result(trial_key: str, result: Result) -> None:
    """Raise ``InvalidResultError`` if the arrays of a result are inconsistent."""
    n = len(result.loss)
    for name in STEP_VALUES:
        _expect_shape(trial_key, result, name, (n,))
    _expect_shape(trial_key, result, "states", (n + 1, None))
    _expect_shape(trial_key, result, "inputs", (n, None))
    _expect_shape(trial_key, result, "parameters", (None,))
    _check_divergence(trial_key, result)
    _check_assessments(trial_key, result)


def _expect_shape(
    trial_key: str, result: Result, name: str, expected: tuple[int | None, ...]
) -> None:
    shape = np.shape(getattr(result, name))
    fits = len(shape) == len(expected) and all(
        want is None or got == want for got, want in zip(shape, expected, strict=True)
    )
    if not fits:
        raise _refusal(
            trial_key, f"'{name}' has shape {shape}, expected {expected} (None means any length)"
        )


def _check_divergence(trial_key: str, result: Result) -> None:
    loss = np.isfinite(np.asarray(result.loss, dtype=np.float64))
    at = result.diverged_at
    if at is None and not loss.all():
        raise _refusal(
            trial_key,
            f"the loss of step {int(np.argmin(loss))} is not finite, but 'diverged_at' is None",
        )
    if at is not None and not 0 <= at < len(loss):
        raise _refusal(trial_key, f"'diverged_at' is {at}, expected a step below {len(loss)}")
    if at is not None and loss[at:].any():
        raise _refusal(trial_key, f"there are losses after the divergence at step {at}")


def _check_assessments(trial_key: str, result: Result) -> None:
    seen: set[tuple[int, str]] = set()
    for row in result.assessments:
        if not 0 <= row.t <= result.n_steps:
            raise _refusal(
                trial_key,
                f"'{row.measure}' is of step {row.t}, expected one from 0 to {result.n_steps}",
            )
        if (row.t, row.measure) in seen:
            raise _refusal(trial_key, f"'{row.measure}' of step {row.t} is given twice")
        seen.add((row.t, row.measure))


def check_horizon(trial_key: str, n_rows: int, horizon: int) -> None:
    """Raise ``InvalidResultError`` unless there is one row for each step of the trial."""
    if n_rows != horizon:
        raise _refusal(trial_key, f"there are {n_rows} steps, expected the horizon {horizon}")


def _refusal(trial_key: str, reason: str) -> InvalidResultError:
    return InvalidResultError(
        f"The result of trial {trial_key[:12]} was not stored: {reason}; correct what made it."
    )
