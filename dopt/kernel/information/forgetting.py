"""Forgetting in compiled code: M decays, and regains what the prior loses."""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import vectorized
from dopt.kernel.information.primal import add_multiple, append_row
from dopt.kernel.state_structs import Covariance
from dopt.types import Vector


@vectorized
def forget(covariance: Covariance, forgetting: float, t: int, renewed: int, renewal: float) -> None:
    """Turn M⁻¹ into (f M + D)⁻¹ at step t (:class:`dopt.learning.ExtendedKalman`).

    D has the entry ``renewal`` at the ``renewed`` diagonal places whose turn it is.
    """
    upper, pending = covariance.upper, covariance.pending
    q = upper.shape[0]
    for i in range(q):
        row = upper[i, i:]
        for j in range(row.shape[0]):
            row[j] /= forgetting
    for k in range(covariance.n_pending[0]):
        for j in range(q):
            pending[k, j] /= np.sqrt(forgetting)
    column = np.empty(q)
    for n in range(renewed):
        i = (t * renewed + n) % q
        _read_column(covariance, i, column)
        factor = np.sqrt(renewal / (1.0 + renewal * column[i]))
        for j in range(q):
            column[j] *= factor
        append_row(covariance, column)


@vectorized
def _read_column(covariance: Covariance, i: int, out: Vector) -> None:
    """Write column i of M⁻¹, (q,)."""
    upper, pending = covariance.upper, covariance.pending
    for j in range(out.shape[0]):
        out[j] = upper[min(i, j), max(i, j)]
    for k in range(covariance.n_pending[0]):
        add_multiple(out, -pending[k, i], pending[k])
