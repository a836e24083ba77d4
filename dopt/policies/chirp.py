"""Chirp input: a sine of rising frequency."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.policies.base import Array, OpenLoop
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class Chirp(OpenLoop):
    """u_j = √(2/m) γ cos(ψ(t) + π j/m), whose frequency rises linearly from zero over the trial.

    For m ≥ 2 the norm is γ at every step; for m = 1 it is u = γ cos ψ. The seed gives the phase at
    the start. Reference: R. Pintelon and J. Schoukens, "System identification: a frequency domain
    approach", 2nd ed., chapter 5 (2012), swept sine.

    Parameters
    ----------
    band : float
        Frequency at the end as a share of the Nyquist frequency 1/(2 dt).
    """

    name: ClassVar[str] = "chirp"

    band: float = parameter(0.1, "1", "share")

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        T, m = system.horizon, system.n_inputs
        time = np.arange(T)
        phase = rng.uniform(0, 2 * np.pi) + np.pi / 2 * self.band * time**2 / T
        size = system.gamma * math.sqrt(2 / m if m > 1 else 1)
        waves: Array = size * np.cos(phase[:, None] + np.pi * np.arange(m) / m)
        return waves
