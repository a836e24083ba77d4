"""Low-pass filter and differences that estimate states of which some are measured with noise.

With y_t the measured states, s = 1 - exp(-2π f_c dt) and f_c the cutoff, the filters of first order
are z_{t+1} = z_t + s (y_{t+1} - z_t) for a measured state and
w_{t+1} = w_t + s ((y_{t+1} - y_t)/dt - w_t) for one that is the rate of a measured state. The
inputs pass through the same filter before they are put with the accelerations of the estimates.

A difference is the rate one step before where the Euler map is simulated, and half a step before
elsewhere. By as much z and the filtered inputs are delayed, so that all of them belong together.
The filters begin at the state from which the steps begin, with inputs of 0; what they give for the
accelerations settles within about 3/(2π f_c) seconds.
"""

from __future__ import annotations

import numpy as np

from dopt.systems.base import System
from dopt.systems.black_box import BlackBox
from dopt.types import Array

TRIED = 16
"""States at which it is tried of which state another one is the rate."""

_SEED = 20_261_123


def differentiated(system: System) -> list[int]:
    """Return for each state the measured one whose difference estimates it, itself if measured.

    It is -1 for a state that is neither measured nor the rate of a measured state, all of which is
    known.
    """
    rng = np.random.default_rng(_SEED)
    states = rng.uniform(-1.0, 1.0, (system.n_states, TRIED))
    inputs = rng.uniform(-1.0, 1.0, (system.n_inputs, TRIED))
    with np.errstate(all="ignore"):
        flow = system.known(tuple(states), tuple(inputs), system.parameters)
        rates = np.stack(np.broadcast_arrays(*flow, states[0])[:-1])
    found = []
    for index, state in enumerate(states):
        kinematic = [i for i in system.measured_states if i not in system.learned_rows]
        of = [i for i in kinematic if np.array_equal(rates[i], state)]
        measured = index in system.measured_states
        found.append(index if measured else of[0] if of else -1)
    return found


def start_variances(system: System) -> Array:
    """Return the variances of a state from which an exploration of a plant begins or goes on, (d,).

    The measured states are known up to their noise, and the others, which are taken for 0, up to
    the half-widths of the box, or 1.
    """
    deviations = np.ones(system.n_states)
    deviations[list(system.grid_indices)] = system.grid_half_widths
    deviations[list(system.measured_states)] = system.measurement_noise
    return deviations**2


def delay(system: System) -> float:
    """Return by how many steps differences come after what they are the rates of."""
    if all(state == of for state, of in enumerate(differentiated(system))):
        return 0.0
    simulated = system.integrator == "euler" and not isinstance(system, BlackBox)
    return 1.0 if simulated else 0.5
