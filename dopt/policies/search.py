"""Search for the best plan among a finite set: the frame of the policies beyond D-optimal."""

from __future__ import annotations

import functools
from abc import abstractmethod
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from dopt.fields import quantity
from dopt.policies.base import Array, Informed, on_sphere
from dopt.systems.base import System

SCORES = ("joint", "sum", "trace", "a", "e", "task")
"""What a plan is judged by; in the order of the compiled kernel."""

TIE_MARGIN = 1e-9
"""Plans whose scores differ by less than this relative margin are equal."""

_REPULSIONS = 400


@dataclass(frozen=True, kw_only=True)
class Search(Informed):
    """Roll the learned model along every plan of a finite set and take the best plan's first input.

    From x_t the model runs x ← x + dt f_θ(x, u) without linearisation. The rows J at the states of
    the path, all r learned components of each, are what the plan would add to M; a score says what
    they are worth. The plan is made anew at each step. Among plans of equal score a random
    direction decides, as it does where every path leaves the bounds of a state: such a path has no
    score. M⁻¹ is held as a q × q matrix.

    With a time budget plans are scored one after the other until it is spent, and the best so far
    is taken: the result then depends on the clock and on the machine. Without one it is
    deterministic.

    Parameters
    ----------
    directions : int
        Candidate inputs on the sphere ‖u‖ = γ; with one input there are two, ±γ.
    budget_us : float
        Time for the search of one step [µs]; 0 is no limit. The first plan is always scored.
    """

    directions: int = quantity(16, "directions", "positive")
    budget_us: float = quantity(0.0, "µs", "nonnegative")

    @property
    @abstractmethod
    def score(self) -> str:
        """What a plan is judged by, one of ``SCORES``."""

    def steps(self, system: System) -> int:  # noqa: ARG002  # a longer plan depends on the system
        """Return the number of steps H of a plan."""
        return 1

    def chosen_form(self, n_parameters: int, n_rows: int) -> str:  # noqa: ARG002  # one form only
        return "primal"

    def candidates(self, system: System) -> Array:
        """Return the candidate inputs, (C, m)."""
        return system.gamma * sphere_directions(system.n_inputs, self.directions)


@functools.lru_cache(maxsize=16)
def sphere_directions(m: int, count: int) -> Array:
    """Return unit vectors, (C, m), spread well over the sphere; the same at every call.

    For m = 1 these are ±1, for m = 2 equal angles from the first axis. Otherwise points of a
    low-discrepancy sequence (M. Roberts, "The unreasonable effectiveness of quasirandom sequences",
    2018) repel each other as charges do.
    """
    if m == 1:
        return np.array([[1.0], [-1.0]])
    if m == 2:
        angles = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = _quasirandom(m, count)
    for i in range(_REPULSIONS):
        gaps = points[:, None] - points
        distances = np.linalg.norm(gaps, axis=-1) + np.eye(count)
        force = (gaps / distances[..., None] ** 3).sum(axis=1)
        force -= (force * points).sum(axis=1, keepdims=True) * points
        largest = np.linalg.norm(force, axis=1).max() + 1e-300
        step = (1 - i / _REPULSIONS) * count ** (-1 / (m - 1))
        points = on_sphere(points + step / (2 * largest) * force, 1.0)
    return points


def _quasirandom(m: int, count: int) -> Array:
    """Return points on the unit sphere, (count, m), from a Kronecker sequence in the cube."""
    root = 2.0
    for _ in range(50):  # the positive root of x^(m + 1) = x + 1
        root = (1.0 + root) ** (1.0 / (m + 1))
    cube = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, m + 1))) % 1.0
    return on_sphere(np.vectorize(NormalDist().inv_cdf)(cube), 1.0)
