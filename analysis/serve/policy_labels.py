"""Labels and line styles of policies, the same as in the figures."""

from __future__ import annotations

from typing import Any

from analysis.line_styles import policy_style


def legend_entry(policy: str) -> dict[str, Any]:
    """Return label, colour, dashes (in units of the line width) and line width of a policy."""
    style = policy_style(policy)
    dash = [] if isinstance(style.line, str) else list(style.line[1])
    return {
        "policy": policy,
        "label": style.label,
        "colour": style.colour,
        "dash": dash,
        "line_width": style.width,
    }
