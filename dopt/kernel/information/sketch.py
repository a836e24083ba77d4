"""Projection of parameter gradients to a few dimensions (count sketch) in compiled code.

Every parameter adds to one of s entries with a random sign, so that inner products are kept on
average; M⁻¹ is then s × s whatever the width and the horizon. Reference: M. Charikar, K. Chen and
M. Farach-Colton, "Finding frequent items in data streams" (2002).
"""

from __future__ import annotations

import numpy as np

from dopt.kernel.compiler import compiled
from dopt.kernel.structs import Sketch
from dopt.types import Matrix


@compiled
def sketched(sketch: Sketch, rows: Matrix) -> Matrix:
    """Return the sketch, (k, s), of gradients, (k, q)."""
    out = np.zeros((rows.shape[0], sketch.size))
    for k in range(rows.shape[0]):
        for i in range(rows.shape[1]):
            out[k, sketch.buckets[i]] += sketch.signs[i] * rows[k, i]
    return out
