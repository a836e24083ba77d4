"""Pseudo-random binary sequence, a common input of linear system identification."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.fields import parameter
from dopt.policies.base import Array, OpenLoop
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class PRBS(OpenLoop):
    """Every component is ±γ/√m, by a shift register of maximal length; the seed gives the phase.

    The register is the shortest whose period, 2ⁿ - 1 clocks, is not shorter than the trial and has
    a place for each input. Input j of m is the same sequence a j-th of the period later: sequences
    so shifted are uncorrelated.
    Reference: L. Ljung, "System identification: theory for the user", 2nd ed., section 13.3 (1999).

    Parameters
    ----------
    hold : int
        Steps for which each value is held: the clock of the register.
    """

    name: ClassVar[str] = "prbs"

    hold: int = parameter(10, "steps", "positive")

    def inputs(self, system: System, rng: np.random.Generator) -> Array:
        from scipy.signal import max_len_seq  # its import takes longer than a short trial

        clocks = -(-system.horizon // self.hold)
        m = system.n_inputs
        bits, _ = max_len_seq(max(2, math.ceil(math.log2(max(clocks, m) + 1))))
        signs = 2.0 * bits - 1.0
        starts = rng.integers(len(signs)) + np.arange(m) * len(signs) // m
        sequence = signs[(np.arange(clocks)[:, None] + starts) % len(signs)]
        held = np.repeat(system.gamma / math.sqrt(m) * sequence, self.hold, axis=0)
        return np.ascontiguousarray(held[: system.horizon])
