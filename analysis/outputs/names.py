"""Names of all outputs of ``analysis figures``, known without what draws them."""

from __future__ import annotations

from analysis.data.trial_selection import Selection
from analysis.tables.registry import TABLES

FIGURES = (
    "figure1",
    "figure1_reachable",
    "figure2_phase_pendulum",
    "figure2_phase_cartpole",
    "figure2_spectrum",
    "figure4_width",
    "figure4_width_loss",
    "figure5_control",
    "figure6_pareto",
    "figure7_profiles",
    "figure8_sensitivity",
    "figure9_limits",
)
"""Figures in the order of the registry."""

NAMES = (*FIGURES, *TABLES)


def partial_warning(selection: Selection) -> str:
    """Return the mark of an output that lacks trials."""
    return f"PARTIAL: {sum(len(gap.seeds) for gap in selection.gaps)} trials missing."
