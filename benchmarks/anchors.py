"""Reference speeds: the authors' code and other implementations of the same task.

All were measured on one core of a two-core machine in float64: cartpole, two hidden layers of 16
units (386 parameters), D-optimal policy. The authors' figures are those of the code that they
released with the paper. Absolute times move with the machine: each says where and when it was
measured, as far as that was kept.
"""

from __future__ import annotations

from benchmarks.rows import Anchor

_AUTHORS = "authors' code, by 2026-11-21, processor not kept"
_LOCKSTEP = "torch.func, 100 trials in lockstep, by 2026-11-21, processor not kept"

STEP = Anchor(15_600, "authors' code, AMD EPYC (family 26, model 2), torch 2.13, 2026-11-27")
"""Plan, step, learn from a window of 100, update M⁻¹ [µs]."""

RANDOM_STEP = Anchor(550, _AUTHORS)
"""A step of the random policy that learns from one sample [µs]."""

EVALUATION = Anchor(870, _AUTHORS)
"""Evaluation on 8,000 points [µs]."""

LOCKSTEP = Anchor(342, _LOCKSTEP)
"""The step of :data:`STEP`, for each trial of the batch [µs]."""
