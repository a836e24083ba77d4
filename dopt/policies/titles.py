"""Titles of the policies for figures, tables and labels, in the order in which they are listed."""

from __future__ import annotations

TITLES: dict[str, str] = {
    "d_optimal": "D-optimal",
    "oracle": "oracle",
    "uniform": "uniform",
    "periodic": "periodic",
    "random": "random",
    "random_held": "held random",
    "random_sphere": "random on the sphere",
    "prbs": "PRBS",
    "multisine": "multisine",
    "chirp": "chirp",
    "periodic_square": "periodic, square wave",
    "max": "ensemble disagreement",
    "gaussian_process": "Gaussian process",
    "gradient": "D-optimal, by gradient",
    "linear": "D-optimal, linear",
    "lookahead": "look-ahead",
    "icem": "iCEM",
    "episodic": "episodic plans",
    "exact": "exact gain",
    "trace": "trace",
    "trace_linearized": "trace, linearised",
    "a_optimal": "A-optimal",
    "e_optimal": "E-optimal",
    "task": "task-optimal",
    "space_filling": "space filling",
}
"""The policies of the paper come first; a user's own policy follows by its name."""


def policy_title(policy: str) -> str:
    """Return the title of a policy; without an entry, its name with spaces."""
    return TITLES.get(policy, policy.replace("_", " "))
