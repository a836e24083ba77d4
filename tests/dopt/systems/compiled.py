"""Compiled equations of a system, compared with its own."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.kernel.equations import compiled_equations
from dopt.systems import System


def assert_compiled_equations_agree(system: System, x: np.ndarray, u: np.ndarray) -> None:
    """Compare f(x, u) of the compiled equations with that of the system."""
    equations = compiled_equations(system)
    p, flow = np.array(system.parameters), np.empty(system.n_states)
    learned = np.empty(system.n_learned)
    equations.known(x, u, p, flow)
    equations.accelerations(x, p, learned)
    flow[list(system.learned_rows)] += learned
    assert flow == pytest.approx(system.derivative(x, u), rel=1e-11, abs=1e-12)
