"""Numbers that other authors printed, as the tables here show them beside their own.

Table 3 of M. Blanke and M. Lelarge, "FLEX: an adaptive exploration algorithm for nonlinear systems"
(ICML 2023): samples until the frictions of N coupled pendulums are known to 1e-2. A number that is
not reached is printed there as "> 1,000"; here it is infinite. Figure 4: parameter error of the
moving star after the run, over 100 trials, read off the plot. Table 1: samples until a planner with
the learned model swings up the pendulum and the cartpole of the DeepMind Control Suite.

ActiveSysID: error of the rate of an unbalanced disk after 2,000 samples, mean over 10 trials, read
off a plot of K. Xie and A. Bemporad, "Online design of experiments by active learning for nonlinear
system identification" (arXiv 2506.21754).
"""

from __future__ import annotations

import math

FLEX_SIZES = (2, 5, 10, 20, 50)
"""Numbers N of pendulums."""

FLEX_SAMPLES = {
    "random": (20.0, 100.0, 200.0, 500.0, math.inf),
    "FLEX": (10.0, 50.0, 100.0, 200.0, 500.0),
}
"""Samples for each N, by policy."""

FLEX_LONGEST = 1000
"""Samples of the longest run in the table."""

FLEX_STAR = {"random": "about 3", "episodic": "0.1 to 1", "FLEX": "about 1e-3"}
"""Parameter errors, by policy; the episodic one plans anew every 50 steps."""

_PENDULUM, _CARTPOLE = ("pendulum", "mlp"), ("cartpole", "mlp")

FLEX_SWING_UP = {
    "random": {_PENDULUM: math.inf, _CARTPOLE: math.inf},
    "MAX": {_PENDULUM: 2000.0, _CARTPOLE: math.inf},
    "SAC": {_PENDULUM: math.inf, _CARTPOLE: math.inf},
    "RHC": {_PENDULUM: 500.0, _CARTPOLE: 600.0},
    "FLEX": {("pendulum", "linear"): 50.0, _CARTPOLE: 300.0},
}
"""Samples by policy, for systems with the kind of model: FLEX has a linear one on the pendulum."""

FLEX_SWING_UP_LONGEST = 2000
"""Samples of the longest run in the table."""

ACTIVE_SYSID = {"random (passive)": 0.93, "gsx": 0.97, "igs": 0.83, "idw": 0.83}
"""Root mean square errors [rad/s] by policy, with the rate bounded."""
