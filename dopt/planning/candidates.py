"""A finite set of inputs on the sphere ‖u‖ = γ, for objectives that are compared and not solved."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_SEED = 20_190_610


def sphere_candidates(n_inputs: int, count: int, radius: float) -> Array:
    """Return inputs on the sphere, (C, m), the same at each call.

    With one input they are ±γ, the whole sphere, whatever the count. With two they divide the
    circle evenly. With more they are directions in pairs of opposite sign, uniform on the sphere by
    normal draws with a fixed seed, after the pairs along the axes.

    Parameters
    ----------
    n_inputs : int
        m.
    count : int
        Number of candidates; odd ones are rounded up, and there are at least 2 m.
    radius : float
        γ > 0.
    """
    if n_inputs == 1:
        return np.array([[radius], [-radius]])
    pairs = max(n_inputs, -(-count // 2))
    if n_inputs == 2:
        angles = np.pi / pairs * np.arange(pairs)
        half = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    else:
        drawn = np.random.default_rng(_SEED).standard_normal((pairs - n_inputs, n_inputs))
        drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
        half = np.concatenate([np.eye(n_inputs), drawn])
    return radius * np.concatenate([half, -half])
