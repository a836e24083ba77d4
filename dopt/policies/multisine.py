"""Multisine input: a sum of sines with a flat spectrum up to a chosen frequency."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.policies.base import Array, OpenLoop
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class Multisine(OpenLoop):
    """Harmonics of the trial's length, of equal power up to a share of the Nyquist frequency.

    Input j of m has harmonics j, j + m, j + 2m ..., so that no two inputs share a frequency. The
    phases are Schroeder's, which keep the peaks low; the seed gives the start. The whole is scaled
    so that its largest norm is γ. References: M. Schroeder, "Synthesis of low-peak-factor signals",
    IEEE Trans. Inf. Theory 16 (1970); R. Pintelon and J. Schoukens, "System identification: a
    frequency domain approach", 2nd ed. (2012).

    Parameters
    ----------
    band : float
        Highest frequency as a share of the Nyquist frequency 1/(2 dt).
    """

    name: ClassVar[str] = "multisine"

    band: float = parameter(0.1, "1", "share")

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        T, m = system.horizon, system.n_inputs
        highest = max(m, int(self.band * T / 2))
        time = np.arange(T) + rng.uniform(0, T)
        waves = np.stack([_wave(np.arange(1 + j, highest + 1, m), time / T) for j in range(m)], 1)
        scaled: Array = system.gamma / np.linalg.norm(waves, axis=1).max() * waves
        return scaled


def _wave(harmonics: np.ndarray[tuple[int], np.dtype[np.int64]], turns: Array) -> Array:
    """Return the sum of cosines of some harmonics at a share of the period, (T,)."""
    count = len(harmonics)
    place = np.arange(1, count + 1)
    phases = -np.pi * place * (place - 1) / count
    total: Array = np.cos(2 * np.pi * np.outer(turns, harmonics) + phases).sum(axis=1)
    return total
