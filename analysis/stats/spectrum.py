"""Power spectral density of inputs.

=======  =============================================  =========
symbol   meaning                                        shape
=======  =============================================  =========
u        inputs of n trials, T steps, m components      (n, T, m)
f        frequencies 0 ... 1/(2 dt) [Hz]                (F,)
S        one-sided density, summed over components      (n, F)
=======  =============================================  =========
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

QUANTILES = (0.1, 0.9)


@dataclass(frozen=True)
class Spectrum:
    """Mean over trials and the 10 % and 90 % quantiles across them, each (F,)."""

    frequency: Array
    mean: Array
    low: Array
    high: Array
    n: int


def periodogram(inputs: Array, dt: float) -> tuple[Array, Array]:
    """Return f [Hz] and S [unit² / Hz] of inputs (n, T, m) sampled every dt seconds.

    Neither window nor detrending: the sum of S times the spacing of f is the mean square of u
    (Parseval).
    """
    from scipy import signal  # its import takes longer than most commands

    frequency, density = signal.periodogram(
        inputs, fs=1 / dt, window="boxcar", detrend=False, scaling="density", axis=1
    )
    return np.asarray(frequency, dtype=float), np.asarray(density, dtype=float).sum(axis=2)


def average_spectrum(inputs: Array, dt: float) -> Spectrum:
    """Return mean and quantiles over trials of the periodograms of inputs (n, T, m)."""
    frequency, density = periodogram(inputs, dt)
    low, high = np.quantile(density, QUANTILES, axis=0)
    return Spectrum(frequency, np.mean(density, axis=0), low, high, len(density))
